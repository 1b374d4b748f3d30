"""Blocks of a virtual scene: given, read from a file, or drawn at random."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from estimation.report import LIMITS, number, read_actual
from hmmseg.contact.decompose import UNITS
from hmmseg.errors import InputError
from hmmseg.io.task import BlockTask

DEFAULT_FRICTION = 1.2  # prior: of foam on a block, where nothing says otherwise


@dataclass(frozen=True)
class Block:
    """One block: weight [N], width and height [m], Coulomb friction against a fingertip."""

    weight: float
    width: float
    height: float
    friction: float = DEFAULT_FRICTION

    def __post_init__(self) -> None:
        for name in ("weight", "width", "height", "friction"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"block {name} is {value!r}; expected a positive number")


Blocks = Mapping[str, Block]

# cited: the blocks of the paper's Table 4, weighed and measured with calipers.
PAPER_BLOCKS: Blocks = {"block1": Block(0.343, 0.0159, 0.0160), "block2": Block(0.437, 0.0254, 0.0127)}


def paper_blocks(task: BlockTask) -> dict[str, Block]:
    """The paper's blocks for the objects of a task: by their names, in turn where names differ."""
    known = list(PAPER_BLOCKS.values())
    return {name: PAPER_BLOCKS.get(name, known[k % len(known)]) for k, name in enumerate(task.objects)}


def blocks_table(blocks: Blocks) -> Table:
    """Blocks for people to read, lengths in cm as the paper has them."""
    table = Table(title="blocks", title_justify="left")
    for head in ("block", "weight", "width", "height", "friction"):
        table.add_column(head)
    for name, b in blocks.items():
        lengths = (f"{100 * length:.4g} cm" for length in (b.width, b.height))
        table.add_row(name, f"{b.weight:.4g} N", *lengths, f"{b.friction:.3g}")
    return table


def random_properties(task: BlockTask, seed: int) -> dict[str, Block]:
    """Blocks for every object of a task, drawn over what two fingers can handle.

    Uniform: weights 0.25-0.65 N, widths 14-29 mm, heights 12-19 mm, friction 1.0-1.4.
    """
    rng = np.random.default_rng([seed, 1])
    return {name: Block(rng.uniform(0.25, 0.65), rng.uniform(0.014, 0.029), rng.uniform(0.012, 0.019),
                        rng.uniform(1.0, 1.4)) for name in task.objects}  # fmt: skip


def read_properties(path: str | Path, task: BlockTask) -> dict[str, Block]:
    """Blocks from an `actual.toml` or from the JSON of `identify`; InputError for anything at fault.

    Values are `value` or `mean`. Friction is taken where its mean is known; a lower bound alone
    leaves the default, raised to the bound. A property that could not be identified is refused.
    """
    path = Path(path)
    if path.suffix.lower() == ".json":
        try:
            table = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise InputError(str(path), "no such file", "identify's JSON or an actual.toml") from None
        except (OSError, ValueError, RecursionError) as error:
            raise InputError(str(path), f"not valid JSON ({error})") from None
        table = table.get("properties") if isinstance(table, dict) else None
        if not isinstance(table, dict):
            raise InputError(f"{path}: key properties", "missing", "the JSON of identify")
    else:
        measured = read_actual(path, task.objects)
        table = {
            name: {key: value for key, (value, _) in entries.items()} for name, entries in measured.items()
        }
    return {name: _block(table.get(name), f"{path}: key {name}") for name in task.objects}


def _block(entry: Any, where: str) -> Block:
    if not isinstance(entry, dict):
        raise InputError(where, "missing", "weight, width and height of every object of the task")
    values = {name: _value(entry.get(name), f"{where}.{name}", unit) for name, unit in UNITS.items()}
    return Block(**values, friction=_friction(entry.get("friction"), f"{where}.friction"))


def _value(entry: Any, where: str, unit: str) -> float:
    if isinstance(entry, dict):
        if entry.get("unit", unit) != unit:
            raise InputError(f"{where}.unit", f"found {entry['unit']!r}", repr(unit))
        entry = entry.get("value", entry.get("mean"))
    low, high = LIMITS[where.rpartition(".")[2].replace("lower_bound", "friction")]
    return number(entry, where, f"a positive number in {unit}, from {low:g} to {high:g}", low, high)


def _friction(entry: Any, where: str) -> float:
    if entry is None:
        return DEFAULT_FRICTION
    if isinstance(entry, dict) and entry.get("mean", entry.get("value")) is None:
        return max(DEFAULT_FRICTION, _value(entry.get("lower_bound"), f"{where}.lower_bound", "1"))
    return _value(entry, where, entry.get("unit", "1") if isinstance(entry, dict) else "1")
