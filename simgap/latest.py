"""What was worked out last, by what it was worked out from."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")
MOST = 8  # numerics: that are kept


def latest(store: dict[Hashable, Any], key: Hashable, make: Callable[[], T], most: int = MOST) -> T:
    """What `store` has by this key, or made now and kept there in the place of what was asked for longest
    ago, where that makes more than so many."""
    found = store.pop(key) if key in store else make()
    store[key] = found
    while len(store) > most:
        del store[next(iter(store))]
    return found
