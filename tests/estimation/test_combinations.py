"""Combinations of heights against the null space of the rises, by linear algebra in floats."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.design import simplest_combinations

NAMES = ("a", "b", "c", "d")


def matrix(rows):
    return np.array([[row.get(name, 0) for name in NAMES] for row in rows], float).reshape(-1, len(NAMES))


def test_a_tower_of_three_reversed_tells_two_sums():
    rises = [{"b": -1, "c": -1}, {"a": 1, "c": -1}, {"a": 1, "b": 1}]
    assert simplest_combinations(rises, NAMES) == [{"b": 1, "c": 1}, {"a": 1, "b": 1}]


def test_single_heights_come_first_and_are_taken_out_of_the_rest():
    rises = [{"a": 1, "b": 1, "c": 1}, {"c": -1}]
    assert simplest_combinations(rises, NAMES) == [{"c": 1}, {"a": 1, "b": 1}]


def test_coefficients_are_coprime_with_the_first_positive():
    assert simplest_combinations([{"a": -2, "b": -4}], NAMES) == [{"a": 1, "b": 2}]


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(st.integers(-1, 1), min_size=4, max_size=4), max_size=6))
def test_they_span_what_the_rises_span_and_single_out_what_is_determined(values):
    rises = [{name: v for name, v in zip(NAMES, row, strict=True) if v} for row in values]
    found = simplest_combinations(rises, NAMES)
    given_rows, rows = matrix(rises), matrix(found)
    rank = np.linalg.matrix_rank(given_rows) if len(given_rows) else 0
    assert len(found) == rank
    assert np.linalg.matrix_rank(np.concatenate([given_rows, rows])) == rank
    _, singular, vt = np.linalg.svd(given_rows, full_matrices=True)
    null = vt[int((singular > 1e-9).sum()) :]
    determined = {
        n for n, column in zip(NAMES, null.T, strict=True) if np.abs(column).max(initial=0.0) < 1e-9
    }
    assert {n for row in found if len(row) == 1 for n in row} == determined
