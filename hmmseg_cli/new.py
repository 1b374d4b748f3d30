"""`hmmseg new`: a commented rig.toml and task.toml to fill in."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from hmmseg.errors import InputError
from hmmseg.io.rig import read_rig
from hmmseg.io.task import read_task
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output, check_folder
from hmmseg_cli.inspect import extended
from hmmseg_cli.options import Hand

if TYPE_CHECKING:
    from hmmseg.hand.inspect import Inspection


def new(
    folder: opt.Folder, hand: opt.HandKind = None, source: opt.Source = None, mjcf: opt.LaidOutModel = None,
    json: opt.Json = None, seed: opt.UnusedSeed = 0, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """A commented rig.toml and task.toml, filled in from a recording or to fill in; or a robot's map.toml."""
    from jinja2 import Environment, PackageLoader

    with Output("new", json=json, seed=seed, quiet=quiet) as out:
        check_folder("FOLDER", folder)
        targets = [folder / name for name in (("rig.toml", "task.toml") if mjcf is None else ("map.toml",))]
        if mjcf is not None and source is None:
            raise InputError("--mjcf", "needs a log", "--from LOG")
        from hmmseg.hand.inspect import inspect as look

        looked = None if source is None else look(source)
        for path in targets:
            if path.exists():
                raise InputError(str(path), "is there already and would be written over", "another folder")
        if mjcf is not None:
            assert looked is not None and source is not None
            _lay_out_map(out, targets[0], mjcf, source, looked)
            out.finish({"files": [str(targets[0])], "hand": None})
            return
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


def _seen(hand: Hand | None, looked: Inspection) -> tuple[Hand, float]:
    """The hand and its sampling rate [Hz], from a recording."""
    names = {channel.name for channel in looked.channels} | set(looked.mapping or ())
    if hand is None and "[gripper]" in looked.toml:
        hand = Hand.GRIPPER
    if hand is None:
        kinds = {Hand.JOINTED: {"q11", "q21"}, Hand.CARTESIAN: {"x1", "x2"}}
        hand = next((kind for kind, needed in kinds.items() if needed <= names), Hand.NONE)
    return hand, float(f"{looked.rate or 50.0:.4g}")


def _lay_out_map(out: Output, path: Path, mjcf: Path, source: Path, looked: Inspection) -> None:
    """Write a map.toml that matches columns of a log with parts of the model by name."""
    from simgap.simulators.mjcf.map import proposed_map

    text, open_columns = proposed_map(mjcf, [(c.name, c.unit) for c in looked.channels if not c.text])
    out.stage(path).write_text(text, encoding="utf-8")
    left = f"; columns left to you: {', '.join(open_columns)}" if open_columns else ""
    out.print(f"wrote {path}{left}")
    out.print(f"then: hmmseg diagnose {source} --mjcf {mjcf} --map {path} --report gap.html")
