"""Times that mean something on a busy machine: processor time, interleaved, the least of many."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

ROUND = 0.1  # numerics: s


def least(
    functions: Mapping[str, Callable[[], object]], seconds: float, most: int = 2000
) -> dict[str, float]:
    """Least processor time [s] of a call of each, all called in turn.

    Each is given about `seconds`, at least three rounds, after one call that warms up. A round is as many
    calls as take ROUND, as the time of other threads is only brought up to date now and then.
    """
    calls = {}
    for name, function in functions.items():
        function()
        began = time.perf_counter()
        function()
        calls[name] = 1 + int(ROUND / max(time.perf_counter() - began, 1e-9))
    best = dict.fromkeys(functions, float("inf"))
    spent = dict.fromkeys(functions, 0.0)
    for turn in range(most):
        left = [name for name in functions if turn < 3 or spent[name] < seconds]
        if not left:
            break
        for name in left:
            began = time.process_time_ns()
            for _ in range(calls[name]):
                functions[name]()
            took = (time.process_time_ns() - began) * 1e-9
            best[name], spent[name] = min(best[name], took / calls[name]), spent[name] + took
    return best
