"""`hmmseg new`: a commented rig.toml and task.toml to fill in."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from hmmseg.errors import InputError
from hmmseg.io.rig import read_rig
from hmmseg.io.task import read_task
from hmmseg_cli.console import JsonOption, Output, QuietOption, UnusedSeed, check_folder
from hmmseg_cli.inspect import extended


class Hand(StrEnum):
    """Kinds of hand that a rig describes."""

    CARTESIAN = "cartesian"
    JOINTED = "jointed"
    GRIPPER = "gripper"
    NONE = "none"


HandOption = Annotated[Hand | None, typer.Option(
    "--hand", help="Fingertips, two-link fingers, a gripper, or none (a plain ordered task).")]  # fmt: skip
FolderArgument = Annotated[Path, typer.Argument(metavar="FOLDER", help="Where the files are written.")]
FromOption = Annotated[Path | None, typer.Option(
    "--from", metavar="FILE", help="Fill in hand, rate and columns from this recording."
)]  # fmt: skip
MjcfFile = Annotated[Path | None, typer.Option(
    "--mjcf", metavar="XML", help="Lay out a map.toml of this model and a log (--from).")]  # fmt: skip


def new(folder: FolderArgument, hand: HandOption = None, source: FromOption = None, mjcf: MjcfFile = None,
        json: JsonOption = None, seed: UnusedSeed = 0, quiet: QuietOption = False) -> None:  # fmt: skip
    """A commented rig.toml and task.toml, filled in from a recording or to fill in; or a robot's map.toml."""
    from jinja2 import Environment, PackageLoader

    with Output("new", json=json, seed=seed, quiet=quiet) as out:
        check_folder("FOLDER", folder)
        if mjcf is not None:
            out.finish({"files": [_map(out, folder / "map.toml", mjcf, source)], "hand": None})
            return
        from hmmseg.hand.inspect import inspect as look

        looked = None if source is None else look(source)
        targets = [folder / "rig.toml", folder / "task.toml"]
        for path in targets:
            _free(path)
        hand, rate = (hand or Hand.CARTESIAN, 50.0) if looked is None else _seen(hand, looked)
        pages = Environment(loader=PackageLoader("hmmseg_cli"), keep_trailing_newline=True, autoescape=False)
        for path, read in zip(targets, (read_rig, read_task), strict=True):
            staged = out.stage(path)
            text = pages.get_template(f"{path.name}.j2").render(hand=hand.value, rate=rate)
            staged.write_text(text, encoding="utf-8")
            if looked is not None and looked.toml and path == targets[0]:
                staged.write_text(extended(staged, [looked]), encoding="utf-8")
            read(staged)
        then = "hmmseg inspect FILE looks into a recording"
        if looked is not None:
            then = ("say in task.toml what goes where, then: "
                    f"hmmseg segment {source} --task {targets[1]} --rig {targets[0]}")  # fmt: skip
        out.print(f"wrote {targets[0]} and {targets[1]}; {then}")
        out.finish({"files": [str(path) for path in targets], "hand": hand.value})


def _free(path: Path) -> None:
    if path.exists():
        raise InputError(str(path), "is there already and would be written over", "another folder")


def _seen(hand: Hand | None, looked: Any) -> tuple[Hand, float]:
    """The hand and its rate [Hz], from what a recording has."""
    names = {channel.name for channel in looked.channels} | set(looked.mapping or ())
    if hand is None and "[gripper]" in looked.toml:
        hand = Hand.GRIPPER
    if hand is None:
        kinds = {Hand.JOINTED: {"q11", "q21"}, Hand.CARTESIAN: {"x1", "x2"}}
        hand = next((kind for kind, needed in kinds.items() if needed <= names), Hand.NONE)
    return hand, float(f"{looked.rate or 50.0:.4g}")


def _map(out: Output, path: Path, mjcf: Path, source: Path | None) -> str:
    """Lay out a map.toml: columns of a log with the parts of a model whose names they hold."""
    from hmmseg.hand.inspect import inspect as look
    from simgap.simulators.mjcf.map import proposed_map

    if source is None:
        raise InputError("--mjcf", "needs a log", "--from LOG")
    _free(path)
    columns = [(c.name, c.unit) for c in look(source).channels if not c.text]
    text, open_columns = proposed_map(mjcf, columns)
    out.stage(path).write_text(text, encoding="utf-8")
    left = f"; columns left to you: {', '.join(open_columns)}" if open_columns else ""
    out.print(f"wrote {path}{left}")
    out.print(f"then: hmmseg diagnose {source} --mjcf {mjcf} --map {path} --report gap.html")
    return str(path)
