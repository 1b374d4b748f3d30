"""Decomposition against the paper's equation 1 and Table 1, a forward model and numerical null spaces."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import null_space

from hmmseg.contact.decompose import (
    VARYING_LOAD,
    Decomposition,
    Source,
    balance,
    decompose,
    determined,
    height_equations,
    subtasks,
)
from hmmseg.io.task import GROUND, BlockTask, Move

PAPER = BlockTask({"block1": "block2", "block2": GROUND}, (Move("block1", GROUND), Move("block2", "block1")))
TOWER = BlockTask({"a": "b", "b": "c", "c": GROUND},
                  (Move("a", GROUND), Move("b", GROUND), Move("c", "b"), Move("a", "c")))  # fmt: skip
SLIDE = BlockTask({"a": GROUND}, (Move("a", GROUND, slide=True),))


def ways(found: Decomposition, owner: str, name: str) -> list[tuple[int, ...]]:
    return [evidence.subtasks for evidence in found.properties[owner][name].evidence]


def test_the_papers_states():
    found = subtasks(PAPER)
    assert [(s.name, s.object) for s in found] == [
        ("pregrasp", "block1"), ("pickup", "block1"), ("carry", "block1"), ("place", "block1"),
        ("release", "block1"), ("pickup", "block2"), ("carry", "block2"), ("place", "block2"),
        ("release", "block2")]  # fmt: skip
    number = {"free-motion": 1, "hold-above-ground": 2, "hold-on-ground": 3}
    assert [number[s.state] for s in found] == [1, 3, 2, 3, 1, 3, 2, 3, 1]
    assert [s.support for s in found] == [None, "block2", None, GROUND, None, GROUND, None, "block1", None]
    assert [s.move for s in found] == [0, 0, 0, 0, 0, 1, 1, 1, 1]
    assert found[1].constraints == ("block1-block2", "finger1-block1", "finger2-block1")
    assert found[2].constraints == ("finger1-block1", "finger2-block1") and found[4].constraints == ()


def test_physics_and_the_papers_table_1_name_what_each_subtask_tells():
    found = decompose(PAPER)
    signals = {i: {entry.name: evidence.signals(i) for entry, evidence in found.reveals(i)
                   if found.in_paper(i, entry)} for i in range(4)}  # fmt: skip
    forces = ("horizontal forces", "vertical forces")
    on_ground = {"height": ("vertical positions",), "friction": forces}
    above = {"weight": ("vertical forces",), "width": ("horizontal positions",), "friction": forces}
    assert signals == {0: {}, 1: on_ground, 2: above, 3: on_ground}
    assert ways(found, "block2", "height") == [(1, 3)]
    assert ways(found, "block1", "width") == [(1,), (2,), (3,)] and ways(found, "block1", "weight") == [(2,)]
    assert ways(found, "block1", "friction") == [(1,), (2,), (3,)]
    assert {name: entry.kind for name, entry in found.properties["block1"].items()} == {
        "weight": "value", "width": "value", "height": "value", "friction": "bound",
        "friction_on_block2": "bound", "friction_on_ground": "bound"}  # fmt: skip


def test_tower_heights_take_several_moves_and_some_are_known_only_together():
    found = decompose(TOWER)
    rises = [{"b": -1, "c": -1}, {"c": -1}, {"b": 1}, {"b": 1, "c": 1}]
    assert height_equations(TOWER) == list(enumerate(rises)) and ways(found, "c", "height") == [(5, 7)]
    assert ways(found, "b", "height") == [(9, 11)]
    short = decompose(BlockTask(TOWER.initial, TOWER.moves[:2]))
    assert ways(short, "b", "height") == [(1, 3, 5, 7)]  # b + c from the first move, c from the second
    assert short.properties["a"]["height"].evidence == ()
    found = decompose(BlockTask(TOWER.initial, TOWER.moves[:1]))
    reasons = {name: entries["height"].reason for name, entries in found.properties.items()}
    assert reasons == {"a": "no recorded move changes the height at which something rests by a's height",
                       "b": "move 1 changes heights by b's only together with the height of c",
                       "c": "move 1 changes heights by c's only together with the height of b"}  # fmt: skip
    for name in ("weight", "width", "friction"):
        assert found.properties["b"][name].reason == "no recorded move grips b"


def test_a_slide_tells_friction_and_weight_together_or_friction_of_a_known_weight():
    found = decompose(SLIDE)
    assert [s.name for s in found.subtasks] == ["pregrasp", "pickup", "slide", "place", "release"]
    assert [s.state for s in found.subtasks][1:4] == ["hold-on-ground", "sliding-on-ground", "hold-on-ground"]
    assert found.subtasks[2].constraints == ("a-ground (slipping)", "finger1-a", "finger2-a")
    # Coulomb's law at several loads is a line: its slope and intercept tell friction and weight.
    for name in ("weight", "friction_on_ground"):
        (evidence,) = found.properties["a"][name].evidence
        assert (evidence.subtasks, evidence.bound, evidence.condition) == ((2,), False, VARYING_LOAD)
        assert evidence.signals() == ("horizontal forces", "vertical forces")
    assert found.properties["a"]["width"].kind == "value"
    found = decompose(BlockTask({"a": GROUND}, (Move("a", GROUND), Move("a", GROUND, slide=True))))
    slid = [e for e in found.properties["a"]["friction_on_ground"].evidence if not e.bound]
    assert [(e.subtasks, e.given, e.condition) for e in slid] == [((6,), (("weight", "a"),), None)]
    assert ways(found, "a", "weight") == [(2,)]


def test_repeats_of_moves_and_unknowns_that_are_known():
    moves = (Move("a", "b"), Move("a", GROUND))
    twice = decompose(BlockTask({"a": GROUND, "b": GROUND}, moves, repeat=2))
    assert [s.move for s in twice.subtasks] == [0] + [m for m in range(4) for _ in range(4)]
    assert ways(twice, "a", "weight") == [(2,), (6,), (10,), (14,)]
    assert ways(twice, "b", "height") == [(1, 3), (5, 7), (9, 11), (13, 15)]
    unknown = decompose(BlockTask({"a": GROUND, "b": GROUND}, moves, repeat="unknown"))
    assert len(unknown.subtasks) == 9
    assert unknown.notes == ("the moves repeat as often as the recording shows; one round is decomposed",)
    both = {("weight", "a"): Fraction(1), ("load",): Fraction(-1), Source(0, "f"): Fraction(-1)}
    assert determined([both]) == {} and set(determined([both], known=[("weight", "a")])) == {("load",)}


@st.composite
def block_tasks(draw):
    """Plain arguments of tasks, as the type checker draws random numbers, which hypothesis forbids."""
    names = ["a", "b", "c", "d"][: draw(st.integers(1, 4))]
    support: dict[str, str] = {}
    for name in names:
        free = [GROUND] + [other for other in support if other not in support.values()]
        support[name] = draw(st.sampled_from(free))
    initial, moves = dict(support), []
    for _ in range(draw(st.integers(1, 6))):
        free = [name for name in names if name not in support.values()]
        name, slide = draw(st.sampled_from(free)), draw(st.booleans())
        to = support[name] if slide else draw(st.sampled_from([GROUND, *(f for f in free if f != name)]))
        moves.append((name, to, slide))
        support[name] = to
    return initial, moves


@settings(max_examples=60, deadline=None)
@given(block_tasks())
def test_heights_agree_with_stacking_and_rank_and_every_property_has_evidence_or_a_reason(arguments):
    task = BlockTask(arguments[0], tuple(Move(*move) for move in arguments[1]))
    heights = dict(zip(task.objects, np.sqrt([2.0, 3.0, 5.0, 7.0]), strict=False))
    support = dict(task.initial)

    def bottom(name: str) -> float:
        return 0.0 if support[name] == GROUND else bottom(support[name]) + heights[support[name]]

    matrix = np.zeros((len(task.moves), len(task.objects)))
    for (index, rise), move in zip(height_equations(task), task.moves, strict=True):
        before = bottom(move.object)
        support[move.object] = move.to
        assert sum(heights[name] * c for name, c in rise.items()) == pytest.approx(
            bottom(move.object) - before
        )
        matrix[index, [task.objects.index(name) for name in rise]] = list(rise.values())
    free = np.abs(null_space(matrix)).max(axis=1, initial=0.0) > 1e-9
    found = decompose(task)
    assert [found.properties[name]["height"].kind == "value" for name in task.objects] == list(~free)
    lifted = {move.object for move in task.moves if not move.slide}
    touched = {move.object for move in task.moves}
    for name, entries in found.properties.items():
        for entry in entries.values():
            assert (entry.reason is None) == bool(entry.evidence)
        plain = [e for e in entries["weight"].evidence if e.condition is None]
        assert bool(plain) == (name in lifted)
        assert (entries["width"].kind, entries["friction"].kind) == (
            ("value", "bound") if name in touched else (None, None))  # fmt: skip


def test_balance_agrees_with_the_jacobian_of_a_forward_model():
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

    carry = subtasks(PAPER)[1:4]
    sliding = BlockTask({"block1": "block2", "block2": GROUND}, (Move("block1", "block2", slide=True),))
    slide = subtasks(sliding)[1:4]
    names = [("weight", "block1"), ("width", "block1"), ("height", "block2"),
             ("friction_on_block2", "block1")]  # fmt: skip
    forward = {id(carry): [(on_support, 1), (lifted, 0), (on_support, 0)],
               id(slide): [(on_support, 1), (slipping, 1), (on_support, 1)]}  # fmt: skip
    for steps in (carry, slide):
        for chosen in ([0], [1], [2], [0, 1], [0, 2], [1, 2], [0, 1, 2]):
            for loads in (1, 3):
                rows = determined(e for i in chosen for e in balance(steps[i], loads))
                free = free_directions([forward[id(steps)][i] for i in chosen], loads)
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
