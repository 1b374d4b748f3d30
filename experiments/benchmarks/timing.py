"""Times that mean something on a busy machine: processor time, interleaved, the least of many."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping


def least(
    functions: Mapping[str, Callable[[], object]], seconds: float, most: int = 2000
) -> dict[str, float]:
    """Least processor time [s] of a call of each, all called in turn.

    Each is given about `seconds`, at least three calls, after one that warms up.
    """
    for function in functions.values():
        function()
    best = dict.fromkeys(functions, float("inf"))
    spent = dict.fromkeys(functions, 0.0)
    for turn in range(most):
        left = [name for name in functions if turn < 3 or spent[name] < seconds]
        if not left:
            break
        for name in left:
            began = time.process_time_ns()
            functions[name]()
            took = (time.process_time_ns() - began) * 1e-9
            best[name], spent[name] = min(best[name], took), spent[name] + took
    return best
