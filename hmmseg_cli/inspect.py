"""`hmmseg inspect` and `hmmseg new`: what is in a recording, and the files that would read it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hmmseg.errors import InputError
from hmmseg.io.rig import parse_rig, read_rig
from hmmseg.io.schema import parse_toml
from hmmseg.io.task import read_task
from hmmseg.tables import listed
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output, check_file, check_folder
from hmmseg_cli.options import Hand

if TYPE_CHECKING:
    from hmmseg.hand.inspect import Inspection

BARS = "▁▂▃▄▅▆▇█"
# Names of a gripper's columns in the template of `hmmseg new`, before they are filled in.
TEMPLATE_NAMES = {"x", "y", "z", "opening", "fx", "fy", "fz", "tx", "ty", "tz"}


def inspect(
    files: opt.Files, rig: opt.JudgingRig = None, write: opt.WrittenRig = None, json: opt.Json = None,
    seed: opt.UnusedSeed = 0, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """What a recording contains, and the [columns] or [topics] that would read it."""
    from hmmseg.hand.inspect import inspect as look

    with Output("inspect", json=json, seed=seed, quiet=quiet) as out:
        if write is not None:
            check_file("--write", write, suffixes=(".toml",))
        hand = None if rig is None else read_rig(rig)
        found = [look(path, hand) for path in files]
        for each in found:
            _show(out, each)
        if write is not None:
            out.stage(write).write_text(extended(write, found), encoding="utf-8")
        out.finish({"files": [_document(each) for each in found]})


def extended(rig_file: Path, found: Sequence[Inspection]) -> str:
    """The rig's text with the mapping added; InputError if it has one already, or none was found."""
    proposed = list(dict.fromkeys(each.toml for each in found if each.toml))
    if not proposed:
        problem = "no mapping was found to propose"
        raise InputError(f"--write {rig_file}", problem, "columns named after what they hold")
    if len(proposed) > 1:
        raise InputError(f"--write {rig_file}", "the files need different mappings", "one at a time")
    text = rig_file.read_text(encoding="utf-8") if rig_file.exists() else ""
    now = parse_rig(parse_toml(text, str(rig_file)), str(rig_file))
    unfilled = now.gripper is not None and set(now.gripper.channels) <= TEMPLATE_NAMES
    import tomlkit

    document = tomlkit.parse(text)
    for name, table in tomlkit.parse(proposed[0]).items():
        there = document.get(name)
        if there and not (name == "gripper" and unfilled):
            raise InputError(f"--write {rig_file}", f"already has [{name}]", "a rig without it")
        if there is None:
            document.add(tomlkit.nl())
            document.add(name, table)
        else:
            there.update(table)
    text = tomlkit.dumps(document).lstrip()
    parse_rig(parse_toml(text, str(rig_file)), str(rig_file))
    return text


def _show(out: Output, found: Inspection) -> None:
    head = f"{found.file}: {found.samples} samples"
    if found.rate is not None and found.start is not None and found.end is not None:
        head += f" at {found.rate:.4g} Hz, {found.end - found.start:.4g} s"
    if found.parts:
        head += f"; the first of {len(found.parts)} recordings ({found.parts[0]} ... {found.parts[-1]})"
    if found.gaps:
        longest = max(end - start for start, end in found.gaps)
        head += f"; {len(found.gaps)} gaps, the longest {longest:.3g} s"
    heads = ("column", "unit", "rate [Hz]", "missing", "least", "most", "course")
    rows = [
        (c.name, "text" if c.text else c.unit or "", _number(c.rate), str(c.missing or ""),
         _number(c.minimum), _number(c.maximum), sparkline(c.course)) for c in found.channels
    ]  # fmt: skip
    out.print(listed(head, heads, rows, right=heads[2:6], wraps=True))
    out.warn(*found.remarks)
    file = shlex.quote(found.file)
    segment = f"hmmseg segment {file} --task task.toml"
    if found.toml:
        out.print("proposed for rig.toml:")
        text = f"{found.toml}\nnext: hmmseg inspect {file} --write rig.toml, or copy it there"
    elif not found.understood:
        text = (f"{found.file}: no name was recognised as a hand's; [columns] in rig.toml says which is "
                "which (hmmseg new lays it out), or a task of named states takes the columns as they are:\n"
                f'sequence = ["...", "..."] in task.toml, then: {segment}')  # fmt: skip
    else:
        then = f"next: {segment} --rig rig.toml" if found.rate else "the times are not"
        text = f"{found.file}: all columns understood; {then}"
    out.print(text, whole=True)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def sparkline(course: tuple[float, ...]) -> str:
    """A course as bars, blank where it is missing."""
    there = [value for value in course if value == value]
    if not there:
        return ""
    low, high = min(there) / 8, max(there) / 8  # the difference of the values themselves may overflow
    steps = [int(8 * (v / 8 - low) / (high - low)) if v == v and high > low else 0 for v in course]
    return "".join(" " if v != v else BARS[min(7, k)] for v, k in zip(course, steps, strict=True))


def _document(found: Inspection) -> dict[str, Any]:
    names = ("name", "unit", "rate", "samples", "missing", "interpolated", "minimum", "maximum", "text")
    return {
        "file": found.file, "recordings": found.parts, "samples": found.samples, "start": found.start,
        "end": found.end, "rate": found.rate, "origin_ns": found.origin,
        "gaps": [{"start": start, "end": end} for start, end in found.gaps],
        "channels": [{name: getattr(c, name) for name in names} for c in found.channels],
        "mapping": found.mapping, "toml": found.toml or None, "findings": found.remarks,
    }  # fmt: skip


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
        hand, rate = (hand or "cartesian", 50.0) if looked is None else _seen(hand, looked)
        pages = Environment(loader=PackageLoader("hmmseg_cli"), keep_trailing_newline=True, autoescape=False)
        for path, read in zip(targets, (read_rig, read_task), strict=True):
            staged = out.stage(path)
            text = pages.get_template(f"{path.name}.j2").render(hand=hand, rate=rate)
            staged.write_text(text, encoding="utf-8")
            if looked is not None and looked.toml and path == targets[0]:
                staged.write_text(extended(staged, [looked]), encoding="utf-8")
            read(staged)
        then = "hmmseg inspect FILE looks into a recording"
        if looked is not None:
            files = shlex.join([str(source), "--task", str(targets[1]), "--rig", str(targets[0])])
            then = f"say in task.toml what goes where, then: hmmseg segment {files}"
        out.print(f"wrote {targets[0]} and {targets[1]}; {then}")
        out.finish({"files": [str(path) for path in targets], "hand": hand})


def _seen(hand: Hand | None, looked: Inspection) -> tuple[Hand, float]:
    """The hand and its sampling rate [Hz], from a recording."""
    names = {channel.name for channel in looked.channels} | set(looked.mapping or ())
    if hand is None and "[gripper]" in looked.toml:
        hand = "gripper"
    if hand is None:
        hand = "jointed" if {"q11", "q21"} <= names else "cartesian" if {"x1", "x2"} <= names else "none"
    return hand, float(f"{looked.rate or 50.0:.4g}")


def _lay_out_map(out: Output, path: Path, mjcf: Path, source: Path, looked: Inspection) -> None:
    """Write a map.toml that matches columns of a log with parts of the model by name."""
    from simgap.simulators.mjcf.map import proposed_map

    columns = [(c.name, c.unit) for c in looked.channels if not c.text]
    text, open_columns = proposed_map(mjcf, columns, looked.mapping.get("t", {}))
    out.stage(path).write_text(text, encoding="utf-8")
    left = f"; columns left to you: {', '.join(open_columns)}" if open_columns else ""
    out.print(f"wrote {path}{left}")
    files = shlex.join([str(source), "--mjcf", str(mjcf), "--map", str(path)])
    out.print(f"then: hmmseg diagnose {files} --report gap.html")
