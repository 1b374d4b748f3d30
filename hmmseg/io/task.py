"""Task descriptions: blocks and moves, or a plain ordered list of states.

`task.toml` holds either objects (each naming what it stands on) and moves, or `sequence`, a list of named
states over arbitrary channels. Contradictory descriptions are refused, naming the move at fault.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hmmseg.errors import InputError, nearest
from hmmseg.io.schema import read_toml

GROUND = "ground"
RESERVED = (GROUND, "finger1", "finger2")
MAX_MOVES = 2000  # limit: with repeats; the cost of computations grows with their square
MAX_REPEAT = 1000  # limit: rounds; more is a typing error


@dataclass(frozen=True)
class Move:
    """One object goes to the ground or onto another object; `slide`: pushed, never lifted."""

    object: str
    to: str
    slide: bool = False


class Task:
    """A task description: `BlockTask` or `SequenceTask`."""

    @staticmethod
    def read(source: str | Path | dict[str, Any] | Task) -> BlockTask | SequenceTask:
        """Read a task description.

        Args:
            source: a `task.toml`, its table as a dict, or a task, which is returned as it is.

        Returns:
            Blocks and moves, or a plain ordered list of states.

        Raises:
            InputError: names the key or the move at fault; also for moves that contradict each other.
        """
        if isinstance(source, BlockTask | SequenceTask):
            return source
        return parse_task(source) if isinstance(source, dict) else read_task(Path(str(source)))


@dataclass(frozen=True)
class BlockTask(Task):
    """Blocks, what each stands on at the start, and the moves in order."""

    initial: dict[str, str]
    moves: tuple[Move, ...]
    repeat: int | Literal["unknown"] = 1  # "unknown": as often as the recording shows

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the blocks, in the order of the description."""
        return tuple(self.initial)

    @property
    def performed(self) -> tuple[Move, ...]:
        """All moves of the task, with repeats written out (once if their number is unknown)."""
        return self.moves * (1 if self.repeat == "unknown" else self.repeat)


@dataclass(frozen=True)
class SequenceTask(Task):
    """A plain ordered task: named states over arbitrary channels, without block physics."""

    sequence: tuple[str, ...]
    channels: tuple[str, ...] | None = None  # None: every column but `t`
    optional: tuple[str, ...] = ()  # states that may be skipped


AnyTask = BlockTask | SequenceTask


def read_task(path: str | Path) -> AnyTask:
    """Task from a `task.toml` file; InputError for anything at fault."""
    return parse_task(read_toml(path), str(path))


def parse_task(table: dict[str, Any], where: str = "task") -> AnyTask:
    """Task from the table of a `task.toml`; InputError names the key or the move at fault."""
    kinds = {"objects", "moves", "repeat"}, {"sequence", "channels", "optional"}
    for key in table:
        if key not in kinds[0] | kinds[1]:
            raise InputError(f"{where}: key {key}", "unknown key", nearest(key, kinds[0] | kinds[1]))
    if "sequence" in table:
        for key in sorted(kinds[0] & set(table)):
            raise InputError(f"{where}: key {key}", "does not go with `sequence`")
        return _parse_sequence(table, where)
    for key in sorted(kinds[1] & set(table)):
        raise InputError(f"{where}: key {key}", "goes only with `sequence`")
    return _parse_blocks(table, where)


def _names(table: dict[str, Any], key: str, where: str) -> tuple[str, ...]:
    value = table[key]
    if not isinstance(value, list) or not all(isinstance(name, str) and name for name in value):
        raise InputError(f"{where}: key {key}", f"found {value!r}", "a list of names")
    return tuple(value)


def _parse_sequence(table: dict[str, Any], where: str) -> SequenceTask:
    sequence = _names(table, "sequence", where)
    if not sequence:
        raise InputError(f"{where}: key sequence", "is empty", "at least one name")
    if len(sequence) > MAX_MOVES:
        raise InputError(f"{where}: key sequence", f"{len(sequence)} states", f"{MAX_MOVES} at most")
    for i, (a, b) in enumerate(itertools.pairwise(sequence)):
        if a == b:
            raise InputError(
                f"{where}: key sequence", f"entries {i + 1} and {i + 2} are both {a!r}",
                "neighbouring states to differ",
            )  # fmt: skip
    channels = _names(table, "channels", where) if "channels" in table else None
    if channels is not None and (not channels or len(set(channels)) != len(channels)):
        raise InputError(f"{where}: key channels", "empty or repeated", "distinct column names")
    optional = _names(table, "optional", where) if "optional" in table else ()
    for name in optional:
        if name not in sequence:
            raise InputError(f"{where}: key optional", f"{name!r} is not in sequence",
                             nearest(name, sequence))  # fmt: skip
    if set(sequence) <= set(optional):
        raise InputError(f"{where}: key optional", "covers all of sequence",
                         "at least one state that is always there")  # fmt: skip
    return SequenceTask(sequence, channels, optional)


def _parse_blocks(table: dict[str, Any], where: str) -> BlockTask:
    objects, moves = table.get("objects"), table.get("moves")
    if not isinstance(objects, dict) or not objects:
        raise InputError(f"{where}: key objects", "missing or empty",
                         "a table [objects.NAME] for every block, or `sequence`")  # fmt: skip
    if not isinstance(moves, list) or not moves:
        raise InputError(f"{where}: key moves", "missing or empty", "at least one [[moves]]")
    initial = {name: _parse_object(name, entry, objects, where) for name, entry in objects.items()}
    _check_supports(initial, where)
    repeat = table.get("repeat", 1)
    if repeat != "unknown" and (isinstance(repeat, bool) or not isinstance(repeat, int)
                                or not 1 <= repeat <= MAX_REPEAT):  # fmt: skip
        raise InputError(f"{where}: key repeat", f"found {repeat!r}",
                         f'a whole number from 1 to {MAX_REPEAT} or "unknown"')  # fmt: skip
    if len(moves) * (1 if repeat == "unknown" else repeat) > MAX_MOVES:
        raise InputError(f"{where}: key moves", f"{len(moves)} moves, repeat {repeat}",
                         f'{MAX_MOVES} moves in all at most, or repeat = "unknown"')  # fmt: skip
    task = BlockTask(initial, tuple(_parse_move(i, m, where) for i, m in enumerate(moves, 1)), repeat)
    _check_moves(task, where)
    return task


def _parse_object(name: str, entry: Any, objects: dict[str, Any], where: str) -> str:
    key = f"{where}: key objects.{name}"
    if name in RESERVED:
        raise InputError(key, f"{name!r} is always there", "another name")
    if not re.fullmatch(r"[\w-]+", name):
        raise InputError(key, f"{name!r} cannot be a name", "letters, digits, - and _")
    if not isinstance(entry, dict) or "on" not in entry:
        raise InputError(f"{key}.on", "missing", "what the object stands on at the start")
    for other in entry:
        if other != "on":
            raise InputError(f"{key}.{other}", "unknown key", "on")
    if not isinstance(entry["on"], str) or entry["on"] not in (GROUND, *objects):
        raise InputError(f"{key}.on", f"unknown object {entry['on']!r}",
                         nearest(str(entry["on"]), [*objects, GROUND]))  # fmt: skip
    return entry["on"]


def _check_supports(initial: dict[str, str], where: str) -> None:
    for name in initial:
        seen, below = [name], initial[name]
        while below != GROUND:
            if below in seen:
                raise InputError(f"{where}: key objects.{name}.on", "objects stand on each other "
                                 "in a circle", "a chain down to the ground")  # fmt: skip
            seen.append(below)
            below = initial[below]
        for other in initial:
            if other != name and initial[other] == initial[name] != GROUND:
                raise InputError(f"{where}: key objects.{other}.on", f"{initial[name]!r} already "
                                 f"carries {name!r}", "one object on another")  # fmt: skip


def _parse_move(number: int, entry: Any, where: str) -> Move:
    key = f"{where}: move {number}"
    if not isinstance(entry, dict):
        raise InputError(key, f"found {entry!r}", "a table with object and to")
    for name in entry:
        if name not in ("object", "to", "slide"):
            raise InputError(f"{key}: key {name}", "unknown key", nearest(name, ("object", "to", "slide")))
    slide = entry.get("slide", False)
    if not isinstance(slide, bool):
        raise InputError(f"{key}: key slide", f"found {slide!r}", "true or false")
    for name in ("object", "to"):
        if not isinstance(entry.get(name), str):
            raise InputError(f"{key}: key {name}", "missing or not a name", "an object's name")
    return Move(entry["object"], entry["to"], slide)


def _check_moves(task: BlockTask, where: str) -> None:
    """Simulate the moves until an arrangement recurs; InputError with the number of an impossible one."""
    support, seen = dict(task.initial), [dict(task.initial)]
    for round_ in range(1, (MAX_REPEAT if task.repeat == "unknown" else task.repeat) + 1):
        for number, move in enumerate(task.moves, 1):
            _check_move(move, support, f"{where}: move {number}" + f" (repeat {round_})" * (round_ > 1))
            support[move.object] = move.to
        if support in seen:
            return
        seen.append(dict(support))


def _check_move(move: Move, support: dict[str, str], key: str) -> None:
    if move.object not in support:
        raise InputError(key, f"unknown object {move.object!r}", nearest(move.object, support))
    if move.to not in (GROUND, *support):
        raise InputError(key, f"unknown destination {move.to!r}", nearest(move.to, [*support, GROUND]))
    if move.to == move.object:
        raise InputError(key, f"{move.object!r} cannot go onto itself", "the ground or another object")
    above = [name for name, below in support.items() if below == move.object]
    if above:
        raise InputError(key, f"{move.object!r} has {above[0]!r} on it", "a free object")
    on_it = [n for n, below in support.items() if below == move.to != GROUND and n != move.object]
    if on_it:
        raise InputError(key, f"destination {move.to!r} already has {on_it[0]!r} on it", "a free destination")
    if move.slide and move.to != support[move.object]:
        raise InputError(key, f"a slide stays on its support ({support[move.object]!r}), "
                         f"but to is {move.to!r}", f"to = {support[move.object]!r}")  # fmt: skip
