"""Task descriptions: what is read, and every description that is refused, with its message."""

import pytest

from hmmseg.errors import InputError
from hmmseg.io.task import BlockTask, Move, SequenceTask, parse_task, read_task

STACK = {"block1": {"on": "block2"}, "block2": {"on": "ground"}}
SWAP = [{"object": "block1", "to": "ground"}, {"object": "block2", "to": "block1"}]
BACK = [{"object": "a", "to": "b"}, {"object": "a", "to": "ground"}]


def test_reads_blocks_and_moves(tmp_path):
    path = tmp_path / "task.toml"
    path.write_text(
        '[objects.block1]\non = "block2"\n[objects.block2]\non = "ground"\n'
        '[[moves]]\nobject = "block1"\nto = "ground"\n'
        '[[moves]]\nobject = "block1"\nto = "ground"\nslide = true\n'
    )
    task = read_task(path)
    assert task == BlockTask(
        {"block1": "block2", "block2": "ground"},
        (Move("block1", "ground"), Move("block1", "ground", slide=True)),
    )
    assert task.objects == ("block1", "block2")


def test_repeat_writes_the_moves_out():
    table = {"objects": {"a": {"on": "ground"}, "b": {"on": "ground"}}, "moves": BACK, "repeat": 3}
    task = parse_task(table)
    assert isinstance(task, BlockTask)
    assert task.performed == task.moves * 3
    unknown = parse_task({**table, "repeat": "unknown"})
    assert isinstance(unknown, BlockTask)
    assert unknown.performed == unknown.moves


def test_reads_a_plain_sequence():
    table = {"sequence": ["a", "b", "a"], "channels": ["fx"], "optional": ["b"]}
    assert parse_task(table) == SequenceTask(("a", "b", "a"), ("fx",), ("b",))
    assert parse_task({"sequence": ["a"]}) == SequenceTask(("a",))


def blocks(objects=STACK, moves=SWAP, **more):
    return {"objects": objects, "moves": moves, **more}


def move(**entry):
    return blocks(moves=[entry])


REFUSED = [
    (blocks(move=[]), "task: key move: unknown key; expected one of channels, moves, objects, optional, "
     r"repeat, sequence \(did you mean moves\?\)"),
    (blocks(sequence=["a"]), "task: key moves: does not go with `sequence`"),
    (blocks(channels=["fx"]), "task: key channels: goes only with `sequence`"),
    ({}, r"task: key objects: missing or empty; expected a table \[objects.NAME\] for every block"),
    (blocks(objects={}), "task: key objects: missing or empty"),
    (blocks(objects=["block1"]), "task: key objects: missing or empty"),
    ({"objects": STACK}, r"task: key moves: missing or empty; expected at least one \[\[moves\]\]"),
    (blocks(moves=[]), "task: key moves: missing or empty"),
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
    (blocks(repeat="often"), "task: key repeat: found 'often'"),
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
]  # fmt: skip


@pytest.mark.parametrize(("table", "message"), REFUSED)
def test_refused_with_its_message(table, message):
    with pytest.raises(InputError, match=f"^{message}") as caught:
        parse_task(table)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_absent_or_malformed(tmp_path):
    with pytest.raises(InputError, match=r"absent\.toml: no such file; expected a TOML file"):
        read_task(tmp_path / "absent.toml")
    (tmp_path / "bad.toml").write_text("moves = [")
    with pytest.raises(InputError, match=r"bad\.toml: not valid TOML: "):
        read_task(tmp_path / "bad.toml")
    (tmp_path / "latin.toml").write_bytes(b'sequence = ["\xe9"]')
    with pytest.raises(InputError, match=r"latin\.toml: cannot be read"):
        read_task(tmp_path / "latin.toml")
    with pytest.raises(InputError, match="cannot be read"):
        read_task(tmp_path)
