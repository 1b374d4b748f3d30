"""`--write` of `hmmseg segment`: where labelled copies of the recordings go."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from hmmseg.errors import InputError
from hmmseg.io.formats import kind_of, split_part
from hmmseg_cli.console import Output, check_file, check_folder

WriteOption = Annotated[Path | None, typer.Option(
    "--write", metavar="FILE",
    help="Write the recording with subtask columns (.csv, .parquet) or a topic (.mcap); for several "
    "recordings, or a LeRobot data set, a folder.")]  # fmt: skip
KINDS = (".csv", ".parquet", ".mcap")


def check_destination(write: Path | None, paths: Sequence[Path]) -> None:
    """InputError unless labelled copies of these recordings can be written there."""
    if write is None:
        return
    where = f"--write {write}"
    if write.suffix.lower() in KINDS:
        if len(paths) > 1:
            raise InputError(where, f"is one file for {len(paths)} recordings", "a folder")
        check_file("--write", write, suffixes=KINDS)
    else:
        check_folder("--write", write)
        sets = {str(split_part(path)[0].resolve()) for path in paths if _is_set(path)}
        if sets and (len(sets) > 1 or not all(_is_set(path) for path in paths)):
            raise InputError(where, "mixes a data set with other recordings", "one data set, or none")
    given = {split_part(path)[0].resolve() for path in paths}
    for target in _targets(write, paths):
        if target.resolve() in given or write.resolve() in given:
            raise InputError(where, "would write over its own recording", "another place")


def write_labels(out: Output, write: Path, paths: Sequence[Path], trials: Sequence[Any],
                 found: Sequence[Any]) -> None:  # fmt: skip
    """Stage the labelled copies."""
    from hmmseg.io.write import lerobot_files, write_mcap, write_table

    if _is_set(paths[0]):
        labelled = {
            int(split_part(path)[1] or 0): (trial, segmentation.spans)
            for path, trial, segmentation in zip(paths, trials, found, strict=True)
        }
        for place, write_to in lerobot_files(split_part(paths[0])[0], labelled).items():
            write_to(out.stage(write / place))
        return
    for target, path, trial, segmentation in zip(_targets(write, paths), paths, trials, found, strict=True):
        writer = write_mcap if target.suffix.lower() == ".mcap" else write_table
        staged = out.stage(target)
        writer(staged, path, trial, segmentation.spans)


def _targets(write: Path, paths: Sequence[Path]) -> list[Path]:
    """One file a recording: the one given, or in the folder under the recording's own name."""
    if write.suffix.lower() in KINDS:
        return [write]
    out = []
    for path in paths:
        file, part = split_part(path)
        kind = (
            ".mcap" if file.suffix.lower() == ".mcap" else ".parquet" if file.suffix == ".parquet" else ".csv"
        )
        out.append(write / f"{file.stem}{f'_{part}' if part else ''}{kind}")
    twice = [name for name in out if out.count(name) > 1]
    if twice:
        raise InputError(
            f"--write {write}", f"two recordings would become {twice[0].name}", "one folder each"
        )
    return out


def _is_set(path: Path) -> bool:
    return kind_of(split_part(path)[0]) == "lerobot"
