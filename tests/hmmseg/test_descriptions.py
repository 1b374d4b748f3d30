"""Rigs and tasks: what is read, and every description that is refused, with its message."""

import math

import pytest
from refusals import refused

from hmmseg.io.rig import Rig, parse_rig, read_rig
from hmmseg.io.task import BlockTask, Move, SequenceTask, parse_task, read_task

FINGER = {"base": [0.05, 0.17], "links": [0.12, 0.12]}
HAND = {"fingers": {"1": FINGER, "2": {**FINGER, "base": [0.21, 0.17]}}}
STACK = {"block1": {"on": "block2"}, "block2": {"on": "ground"}}
SWAP = [{"object": "block1", "to": "ground"}, {"object": "block2", "to": "block1"}]
BACK = [{"object": "a", "to": "b"}, {"object": "a", "to": "ground"}]
GRIPPERS = [
    ({"frame": "base"}, "key gripper.frame: "),
    ({"wrench": ["fx"]}, "key gripper.wrench: has 1 columns; expected 3 forces"),
    ({"mass": 1}, r"key gripper.mass: unknown key; .*tool_mass\?"),
    ({"sensor_axes": ["x", "y", "-z"]}, ".*gripper.sensor_axes: x, y, -z are no right-handed axes"),
    ({"position": {"x": "a", "y": "b"}}, ".*position has no column for z, the axis that is up"),
    ({"force_per_ampere": 3.0}, ".*force_per_ampere without motor_current"),
    ({"grip_force": 1e308}, "key gripper.grip_force")]  # fmt: skip


def test_uncertainty_gripper_and_tolerance_are_read_and_what_is_left_out_has_its_default():
    rig = parse_rig({})
    assert rig == Rig() and not rig.jointed and rig.gravity == 9.80665
    assert math.isinf(rig.fingertip.normal_stiffness) and rig.noise.force is None
    with pytest.raises(ValueError, match="a Cartesian hand has no fingers"):
        rig.finger(1)
    rig = parse_rig({"systematic": {"force_bias": 0.01, "force_gain": [0.1, 0.2, 0.3, 0.4],
                                    "joint_offset": {"q12": 0.002}, "pad_stiffness": 1}})  # fmt: skip
    assert rig.systematic.force_bias == (0.01,) * 4 and rig.systematic.force_gain == (0.1, 0.2, 0.3, 0.4)
    assert rig.systematic.joint_offset == (0.0, 0.002, 0.0, 0.0)
    assert rig.systematic.pad_stiffness == (1.0, 1.0) and rig.systematic.link_length == (0.0,) * 4
    rig = parse_rig({"tolerance": {"position": 1e-3}, "gripper": {"opening": "width", "tool_mass": 0.5}})
    assert (rig.tolerance.position, rig.tolerance.property) == (1e-3, None)
    assert rig.gripper.channels[:4] == ("x", "y", "z", "width") and rig.gripper.tool_mass == 0.5


REFUSED = [
    ({"speed": 1}, r"rig: key speed: unknown key; expected one of .*rate.* \(did you mean"),
    ({"fingers": {"1": {**FINGER, "length": 1}, "2": FINGER}},
     r"rig: key fingers.1.length: unknown key; .*links"),
    ({"fingers": {"1": FINGER}}, r"rig: fingers must be the two tables \[fingers.1\] and \[fingers.2\]"),
    ({"fingers": {"1": FINGER, "2": {"base": [0, 0]}}}, "rig: key fingers.2.links: missing"),
    ({"fingers": {"1": FINGER, "2": {**FINGER, "links": [0.1, -0.1]}}},
     r"rig: key fingers.2.links.1: .*greater than 0 \(found -0.1\)"),
    ({"fingers": {"1": FINGER, "2": {**FINGER, "base": [0.1, math.nan]}}},
     r"rig: key fingers.2.base.1: .*finite"),
    ({"rate": 0}, r"rig: key rate: Input should be greater than 0 \(found 0"),
    ({"rate": True}, r"rig: key rate: Input should be a valid number \(found True\)"),
    ({"gravity": 980.665}, r"rig: key gravity: .*less than or equal to 100"),
    ({"fingers": {"1": FINGER, "2": {**FINGER, "links": [120, 120]}}},
     r"rig: key fingers.2.links.0: .*less than or equal to 10 \(found 120"),
    ({"fingertip": {"normal_stiffness": math.nan}}, r"rig: key fingertip.normal_stiffness: .*greater than 0"),
    ({"noise": {"force": 0}}, r"rig: key noise.force: .*greater than 0"),
    ({"noise": 0.1}, r"rig: key noise: .*dictionary"),
    ({"systematic": {"force_bias": -0.1}}, r"rig: key systematic.force_bias.0: .*greater than or equal to 0"),
    ({"systematic": {"force_bias": [0.1, 0.1]}}, r"rig: key systematic.force_bias.2: missing"),
    ({"systematic": {"force_bias": [0.1] * 5}}, r"rig: key systematic.force_bias: .*at most 4"),
    ({"systematic": {"force_bias": {"fz1": 0.1}}},
     r"rig: key systematic.force_bias: unknown entry fz1; expected one of fx1, .*did you mean f"),
    ({"systematic": {"force_bias": True}}, r"rig: key systematic.force_bias: must be a number"),
    ({"systematic": {"force_bias": 10**400}}, r"rig: key systematic.force_bias: must be at most 1e\+12"),
    ({"noise": {"force": 1e300}}, r"rig: key noise.force: .*less than or equal to"),
    ({"columns": {"x1": {"from": "a", "unit": "furlong"}}},
     "rig: key columns.x1.unit: unknown unit 'furlong'"),
    ({"columns": {"x1": {"from": "a", "sing": 1}}},
     r"rig: key columns.x1.sing: unknown key; .*did you mean sign\?"),
    ({"columns": {"x1": {"from": "a", "sign": 2}}}, "rig: key columns.x1.sign: found 2; expected 1 or -1"),
    ({"columns": {"x1": {"from": ""}}}, "rig: key columns.x1.from: .*at least 1 character"),
    ({"columns": {"x1": 3}}, "rig: key columns.x1: "),
    ({"columns": {"x1": {"unit": -1.0}}}, "rig: key columns.x1.unit"),
    ({"columns": {"t": {"unit": "mm"}}}, "rig: key columns: t is a time, but its unit mm is one of length"),
    ({"columns": {"fx1": {"unit": "deg"}}},
     "rig: key columns: fx1 is a force, but its unit deg is one of angle"),
    ({"gripper": {}}, r"rig: a hand has \[fingers\] or is a \[gripper\], not both")]  # fmt: skip


@pytest.mark.parametrize(("table", "message"), [
    *(({**HAND, **table}, message) for table, message in REFUSED),
    *(({"gripper": table}, f"rig: {message}") for table, message in GRIPPERS)])  # fmt: skip
def test_refused_with_its_message(table, message):
    refused(f"^{message}", parse_rig, table)


def test_reads_blocks_moves_repeats_and_plain_sequences(tmp_path):
    path = tmp_path / "task.toml"
    path.write_text('[objects.block1]\non = "block2"\n[objects.block2]\non = "ground"\n'
                    '[[moves]]\nobject = "block1"\nto = "ground"\n'
                    '[[moves]]\nobject = "block1"\nto = "ground"\nslide = true\n')  # fmt: skip
    task = read_task(path)
    assert task == BlockTask({"block1": "block2", "block2": "ground"},
                             (Move("block1", "ground"), Move("block1", "ground", slide=True)))  # fmt: skip
    assert task.objects == ("block1", "block2")
    table = {"objects": {"a": {"on": "ground"}, "b": {"on": "ground"}}, "moves": BACK, "repeat": 3}
    task = parse_task(table)
    assert isinstance(task, BlockTask) and task.performed == task.moves * 3
    unknown = parse_task({**table, "repeat": "unknown"})
    assert isinstance(unknown, BlockTask) and unknown.performed == unknown.moves
    table = {"sequence": ["a", "b", "a"], "channels": ["fx"], "optional": ["b"]}
    assert parse_task(table) == SequenceTask(("a", "b", "a"), ("fx",), ("b",))
    assert parse_task({"sequence": ["a"]}) == SequenceTask(("a",))


def blocks(objects=STACK, moves=SWAP, **more):
    return {"objects": objects, "moves": moves, **more}


def move(**entry):
    return blocks(moves=[entry])


@pytest.mark.parametrize(("table", "message"), [
    (blocks(move=[]), "task: key move: unknown key; expected one of channels, moves, objects, optional, "
     r"repeat, sequence \(did you mean moves\?\)"),
    (blocks(sequence=["a"]), "task: key moves: does not go with `sequence`"),
    (blocks(channels=["fx"]), "task: key channels: goes only with `sequence`"),
    ({}, r"task: key objects: missing or empty; expected a table \[objects.NAME\] for every block"),
    (blocks(objects=["block1"]), "task: key objects: missing or empty"),
    ({"objects": STACK}, r"task: key moves: missing or empty; expected at least one \[\[moves\]\]"),
    (blocks(moves={"object": "block1"}), "task: key moves: missing or empty"),
    (blocks(objects={"ground": {"on": "ground"}}), "task: key objects.ground: 'ground' is always there"),
    (blocks(objects={"finger1": {"on": "ground"}}), "task: key objects.finger1: 'finger1' is always there"),
    (blocks(objects={"my block": {"on": "ground"}}),
     "task: key objects.my block: 'my block' cannot be a name; expected letters, digits, - and _"),
    (blocks(objects={"a.b": {"on": "ground"}}), "task: key objects.a.b: 'a.b' cannot be a name"),
    (blocks(objects={"a": {}}), "task: key objects.a.on: missing; expected what the object stands on"),
    (blocks(objects={"a": "ground"}), "task: key objects.a.on: missing"),
    (blocks(objects={"a": {"on": "ground", "mass": 1}}), "task: key objects.a.mass: unknown key"),
    (blocks(objects={"a": {"on": "grund"}}), r"task: key objects.a.on: unknown object 'grund'; .*ground"),
    (blocks(objects={"a": {"on": ["ground"]}}), r"task: key objects.a.on: unknown object \['ground'\]"),
    (blocks(objects={"a": {"on": "a"}}), "task: key objects.a.on: objects stand on each other in a circle"),
    (blocks(objects={"a": {"on": "b"}, "b": {"on": "a"}}), "task: key objects.a.on: .* in a circle"),
    (blocks(objects={"a": {"on": "c"}, "b": {"on": "c"}, "c": {"on": "ground"}}),
     "task: key objects.b.on: 'c' already carries 'a'; expected one object on another"),
    (blocks(repeat=0), 'task: key repeat: found 0; expected a whole number from 1 to 1000 or "unknown"'),
    (blocks(repeat=2.0), "task: key repeat: found 2.0"),
    (blocks(repeat=True), "task: key repeat: found True"),
    (blocks(repeat=10**9), "task: key repeat: found 1000000000"),
    (blocks(moves=["block1"]), "task: move 1: found 'block1'; expected a table with object and to"),
    (move(object="block1", too="ground"), "task: move 1: key too: unknown key; .*did you mean to"),
    (move(object="block1"), "task: move 1: key to: missing or not a name; expected an object's name"),
    (move(to="ground"), "task: move 1: key object: missing or not a name"),
    (move(object=["block1"], to="ground"), "task: move 1: key object: missing or not a name"),
    (move(object="block1", to="ground", slide=1), "task: move 1: key slide: found 1; expected true or false"),
    (move(object="block3", to="ground"), "task: move 1: unknown object 'block3'; expected one of block1"),
    (move(object="ground", to="block1"), "task: move 1: unknown object 'ground'"),
    (move(object="block1", to="table"), "task: move 1: unknown destination 'table'; expected .*ground"),
    (move(object="block1", to="block1"), "task: move 1: 'block1' cannot go onto itself"),
    (move(object="block2", to="ground"), "task: move 1: 'block2' has 'block1' on it; expected a free object"),
    (blocks({**STACK, "c": {"on": "ground"}}, [{"object": "c", "to": "block2"}]),
     "task: move 1: destination 'block2' already has 'block1' on it; expected a free destination"),
    (blocks(moves=[*SWAP, {"object": "block1", "to": "ground"}]), "task: move 3: 'block1' has 'block2'"),
    (move(object="block1", to="ground", slide=True),
     r"task: move 1: a slide stays on its support \('block2'\), but to is 'ground'; expected to = 'block2'"),
    (blocks(repeat=2), r"task: move 1 \(repeat 2\): 'block1' has 'block2' on it"),
    (blocks(repeat="unknown"), r"task: move 1 \(repeat 2\): 'block1' has 'block2' on it"),
    ({"sequence": []}, "task: key sequence: is empty; expected at least one name"),
    ({"sequence": "a"}, "task: key sequence: found 'a'; expected a list of names"),
    ({"sequence": ["a", 2]}, r"task: key sequence: found \['a', 2\]; expected a list of names"),
    ({"sequence": ["a", ""]}, "task: key sequence: found .*; expected a list of names"),
    ({"sequence": ["a", "b", "b"]}, "task: key sequence: entries 2 and 3 are both 'b'; expected"),
    ({"sequence": ["a"], "channels": []}, "task: key channels: empty or repeated"),
    ({"sequence": ["a"], "channels": ["f", "f"]}, "task: key channels: empty or repeated; expected distinct"),
    ({"sequence": ["a", "b"], "optional": ["c"]}, "task: key optional: 'c' is not in sequence; .* a, b"),
    ({"sequence": ["a", "b"], "optional": ["a", "b"]}, "task: key optional: covers all of sequence"),
])  # fmt: skip
def test_a_task_refused_with_its_message(table, message):
    refused(f"^{message}", parse_task, table)


@pytest.mark.parametrize("read", [read_rig, read_task])
def test_a_file_that_is_absent_or_malformed(read, tmp_path):
    (tmp_path / "marked.toml").write_text('sequence = ["a", "b"]', encoding="utf-8-sig")  # by an editor
    assert read_task(tmp_path / "marked.toml").sequence == ("a", "b")
    (tmp_path / "bad.toml").write_text("moves = [")
    (tmp_path / "latin.toml").write_bytes(b'sequence = ["\xe9"]')
    for name, line in (("absent.toml", r"absent\.toml: no such file; expected a TOML file"),
                       ("bad.toml", r"bad\.toml: not valid TOML: "),
                       ("latin.toml", r"latin\.toml: cannot be read"), (".", "cannot be read")):  # fmt: skip
        refused(line, read, tmp_path / name)
