"""A small cache of the most recently used results."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")
MOST = 8  # numerics: most results kept


def latest(store: dict[Hashable, Any], key: Hashable, make: Callable[[], T], most: int = MOST) -> T:
    """The result under `key`, made if missing; beyond `most` the least recently used is dropped."""
    found = store.pop(key) if key in store else make()
    store[key] = found
    while len(store) > most:
        del store[next(iter(store))]
    return found
