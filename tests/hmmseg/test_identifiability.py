"""What balances determine, against a forward model and numerical null spaces."""

from fractions import Fraction

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import null_space

from hmmseg.contact.decompose import Source, balance, contact_states, determined
from hmmseg.io.task import GROUND, BlockTask, Move

PAPER = BlockTask({"block1": "block2", "block2": GROUND}, (Move("block1", GROUND), Move("block2", "block1")))
TOWER = BlockTask(
    {"a": "b", "b": "c", "c": GROUND}, (Move("a", GROUND), Move("b", GROUND), Move("c", "b"), Move("a", "c"))
)
SLIDE = BlockTask({"a": GROUND}, (Move("a", GROUND, slide=True),))


def test_balance_agrees_with_the_jacobian_of_a_forward_model():
    """One grasp each of a carry and a slide, measured at several instants, perturbed numerically."""
    weight, width, below, mu, grip1, grip2 = range(6)
    truth = np.array([0.4, 0.02, 0.015, 0.3, 0.008, 0.007])

    def on_support(p, q, height):  # q: load and push of the support
        return [p[width], height + p[grip1], height + p[grip2], p[weight] - q[0], -q[1]]

    def slipping(p, q, height):
        return on_support(p, [q[0], -p[mu] * q[0]], height)

    def lifted(p, q, height):
        del height
        return [p[width], q[0] + p[grip1], q[0] + p[grip2], p[weight], 0.0]

    def free_directions(steps, loads):
        unknowns = np.concatenate([truth, np.linspace(0.2, 0.9, 2 * len(steps) * loads)])

        def measure(u):
            latent = iter(u[6:].reshape(-1, 2))
            return np.concatenate([state(u, next(latent), u[below] * raised)
                                   for state, raised in steps for _ in range(loads)])  # fmt: skip

        h = 1e-6 * np.eye(unknowns.size)
        jacobian = np.array([(measure(unknowns + e) - measure(unknowns - e)) / 2e-6 for e in h]).T
        _, values, rows = np.linalg.svd(jacobian)
        rank = (values > 1e-7).sum()
        return np.abs(rows[rank:]).max(axis=0, initial=0.0)[:4] > 1e-6

    carry = list(contact_states(PAPER))[1:4]
    slide = [s for s in contact_states(BlockTask({"block1": "block2", "block2": GROUND},
                                                 (Move("block1", "block2", slide=True),)))][1:4]  # fmt: skip
    names = [
        ("weight", "block1"),
        ("width", "block1"),
        ("height", "block2"),
        ("friction_on_block2", "block1"),
    ]
    forward = {id(carry): [(on_support, 1), (lifted, 0), (on_support, 0)],
               id(slide): [(on_support, 1), (slipping, 1), (on_support, 1)]}  # fmt: skip
    for states in (carry, slide):
        for chosen in ([0], [1], [2], [0, 1], [0, 2], [1, 2], [0, 1, 2]):
            for loads in (1, 3):
                rows = determined(e for i in chosen for e in balance(i, states[i], loads))
                free = free_directions([forward[id(states)][i] for i in chosen], loads)
                assert [name in rows for name in names] == list(~free), (chosen, loads)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(st.integers(-2, 2), min_size=5, max_size=5), min_size=1, max_size=6))
def test_elimination_agrees_with_numerical_null_space(rows):
    equations = [
        {("weight", str(j)): Fraction(c) for j, c in enumerate(row) if c} | {Source(i, "f"): Fraction(-1)}
        for i, row in enumerate(rows)
    ]
    found = determined(equations)
    free = np.abs(null_space(np.array(rows, dtype=float))).max(axis=1, initial=0.0) > 1e-9
    assert {int(name) for _, name in found} == set(np.flatnonzero(~free))
    for (_, name), row in found.items():  # its sources are the combination that leaves it alone
        combined = sum(float(c) * np.array(rows[source.subtask]) for source, c in row.items())
        np.testing.assert_allclose(combined, np.eye(5)[int(name)], atol=1e-12)


def test_known_unknowns_are_given():
    both = {("weight", "a"): Fraction(1), ("load",): Fraction(-1), Source(0, "f"): Fraction(-1)}
    assert determined([both]) == {}
    assert set(determined([both], known=[("weight", "a")])) == {("load",)}
