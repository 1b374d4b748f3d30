"""`hmmseg inspect`: what is in a recording, and the mapping that would read it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hmmseg.errors import InputError
from hmmseg.io.rig import parse_rig, read_rig
from hmmseg.io.schema import parse_toml
from hmmseg.tables import listed
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output, check_file

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
        raise InputError(
            f"--write {rig_file}", "no mapping was found to propose", "columns named after what they hold"
        )
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
    out.warn(*found.said)
    segment = f"hmmseg segment {found.file} --task task.toml"
    if found.toml:
        out.print("proposed for rig.toml:")
        text = f"{found.toml}\nnext: hmmseg inspect {found.file} --write rig.toml, or copy it there"
    elif not found.understood:
        text = (f"{found.file}: no name was recognised as a hand's; [columns] in rig.toml says which is "
                "which (hmmseg new lays it out), or a task of named states takes the columns as they are:\n"
                f'sequence = ["...", "..."] in task.toml, then: {segment}')  # fmt: skip
    else:
        text = f"{found.file}: all columns understood; next: {segment} --rig rig.toml"
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
        "mapping": found.mapping, "toml": found.toml or None, "findings": found.said,
    }  # fmt: skip
