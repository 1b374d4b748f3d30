"""Which sets are proposed: by what each gains alone, and by what helps only together."""

from __future__ import annotations

import numpy as np

from simgap.attribution.posterior import Forms, forms
from simgap.attribution.problem import Candidate, Gap, Rows
from simgap.robots.proposals import nearest, one_more, two_more

N = 600


def told(residual: np.ndarray, **columns: np.ndarray) -> Forms:
    """A gap of one channel, and candidates by these columns (N,)."""
    rows = Rows(np.zeros(N, int), np.zeros(N, int), np.zeros(N, int), np.arange(N) / 100,
                ("log",), ("q",), ("whole",))  # fmt: skip
    one = np.ones(1)
    made = tuple(
        Candidate(name, ("size",), 0 * one, 0 * one, one, np.zeros(N), c[:, None], -9 * one, 9 * one)
        for name, c in columns.items()
    )
    return forms(Gap(rows, residual, np.zeros((N, 0)), made))


def names(f: Forms, effects: tuple[int, ...]) -> set[str]:
    return {f.gap.candidates[j].name for j in effects}


def test_two_that_help_only_together_are_proposed():
    """Of each most is of another direction, which the other takes back."""
    rng = np.random.default_rng(0)
    gap, other, spare = (rng.standard_normal(N) for _ in range(3))
    f = told(gap + 0.1 * rng.standard_normal(N), a=0.5 * gap + 9 * other, b=0.5 * gap - 9 * other, c=spare)
    assert names(f, one_more(f, [])[0].effects) == set()
    assert names(f, two_more(f, [])[0].effects) == {"a", "b"}


def test_one_that_stands_in_for_two_is_exchanged_for_them():
    rng = np.random.default_rng(1)
    a, b, spare = (rng.standard_normal(N) for _ in range(3))
    f = told(a + b + 0.1 * rng.standard_normal(N), both=a + 0.8 * b, a=a, b=b, c=spare)
    assert names(f, two_more(f, [0])[0].effects) == {"a", "b"}


def test_candidates_go_by_their_better_rank():
    rng = np.random.default_rng(2)
    a, b, c = (rng.standard_normal(N) for _ in range(3))
    first, second = told(3 * a + b, a=a, b=b, c=c), told(3 * b + a, a=a, b=b, c=c)
    assert nearest([first], []) == ["a", "b", "c"]
    assert nearest([first, second], [])[:2] == ["a", "b"] and nearest([second, first], [])[:2] == ["b", "a"]
    assert nearest([first], ["a"]) == ["b", "c"]
