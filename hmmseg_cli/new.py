"""`hmmseg new`: a commented rig.toml and task.toml to fill in."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from hmmseg.errors import InputError
from hmmseg.io.rig import read_rig
from hmmseg.io.task import read_task
from hmmseg_cli.console import JsonOption, Output, QuietOption, UnusedSeed, check_folder


class Hand(StrEnum):
    """Kinds of hand that a rig describes."""

    CARTESIAN = "cartesian"
    JOINTED = "jointed"
    GRIPPER = "gripper"
    NONE = "none"


HandOption = Annotated[Hand | None, typer.Option(
    "--hand", help="Fingertips, two-link fingers, a gripper, or none (a plain ordered task).")]  # fmt: skip
FolderArgument = Annotated[Path, typer.Argument(metavar="FOLDER", help="Where the files are laid out.")]
QUESTION = "Which hand: cartesian (fingertip positions), jointed (joint angles), gripper, or none"


def new(folder: FolderArgument, hand: HandOption = None, json: JsonOption = None, seed: UnusedSeed = 0,
        quiet: QuietOption = False) -> None:  # fmt: skip
    """A rig.toml and task.toml with comments, to fill in; asks what it must on a terminal."""
    from jinja2 import Environment, PackageLoader

    with Output("new", json=json, seed=seed, quiet=quiet) as out:
        check_folder("FOLDER", folder)
        targets = [folder / "rig.toml", folder / "task.toml"]
        for path in targets:
            if path.exists():
                raise InputError(str(path), "is there already and would be written over", "another folder")
        hand, rate = _asked(hand)
        pages = Environment(loader=PackageLoader("hmmseg_cli"), keep_trailing_newline=True, autoescape=False)
        for path, read in zip(targets, (read_rig, read_task), strict=True):
            staged = out.stage(path)
            text = pages.get_template(f"{path.name}.j2").render(hand=hand.value, rate=rate)
            staged.write_text(text, encoding="utf-8")
            read(staged)
        out.print(
            f"{targets[0]} and {targets[1]} are laid out; look into a recording with hmmseg inspect FILE"
        )
        out.finish({"files": [str(path) for path in targets], "hand": hand.value})


def _asked(hand: Hand | None) -> tuple[Hand, float]:
    """The hand and its rate [Hz]: from the terminal where there is one, else as most have it."""
    if not (sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()):
        return hand or Hand.CARTESIAN, 50.0
    if hand is None:
        hand = Hand(typer.prompt(QUESTION, default="cartesian", type=Hand, err=True))
    rate = typer.prompt("Samples per second", default=50.0, type=float, err=True)
    if not 0 < rate < 1e6:
        raise InputError("samples per second", f"found {rate:g}", "a rate in Hz")
    return hand, rate
