"""Fill the tables of README.md and docs/ from the results that the experiments saved.

    python -m experiments.write_tables

Text between <!-- name --> and <!-- /name --> is replaced; what has no result yet stays as it is.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from experiments import (
    calibration,
    calibration_worlds,
    gap_drawn,
    gap_recordings,
    sbc,
    score_recordings,
    sequences,
    table_robots,
    wrist,
)
from experiments.benchmarks import commands, haptic_loop, long_recordings, watch
from experiments.blind_check import tables as blind_check
from experiments.real import hiro_snap
from experiments.table_text import as_csv, load

ROOT = Path(__file__).parents[1]
GIVEN = "robots_check_given"


# Page, name of the table on it (none: the whole file), results it is made of, what makes it, and the target
# that measures them.
TABLES: tuple[tuple[str, str, str, Callable[..., str | None], str], ...] = (
    ("README.md", "results", "calibration", calibration.headline, "results"),
    ("docs/results.md", "results", "calibration benchmark_commands", calibration.results, "results"),
    ("docs/results.md", "rivals", score_recordings.SAVED, score_recordings.table, "results"),
    ("docs/results.md", "real", "hiro_snap", hiro_snap.table, "real"),
    ("docs/tables/calibration.csv", "", "calibration", calibration.table, "results"),
    ("docs/tables/worlds.csv", "", "calibration_worlds", calibration_worlds.table, "calibrate"),
    ("docs/tables/sbc.csv", "", "sbc", sbc.table, "calibrate"),
    ("docs/results.md", "gap", "gap_recordings", gap_recordings.describe, "gap-results"),
    ("docs/gap_results.md", "recordings", "gap_recordings", gap_recordings.table, "gap-results"),
    ("docs/gap_results.md", "labs", "gap_labs", gap_drawn.table, "gap-labs"),
    ("docs/gap_results.md", "fresh", "gap_fresh", gap_drawn.table, "gap-fresh"),
    ("docs/gap_results.md", "blind", "", blind_check.blind, "blind-check"),
    ("docs/tables/blind.csv", "", "", blind_check.by_circumstance, "blind-check"),
    ("docs/benchmarks.md", "commands", "benchmark_commands", commands.table, "bench"),
    ("docs/benchmarks.md", "lengths", "benchmark_long", long_recordings.table, "bench-long"),
    ("docs/virtual_model.md", "haptic", "haptic_loop", haptic_loop.table, "bench-haptic"),
    ("docs/watch.md", "watch", "watch", watch.table, "bench-watch"),
    ("docs/robots_results.md", "minute", "benchmark_robot", table_robots.minute, "bench-robot"),
    ("docs/robots_results.md", "robots_check_given", GIVEN, table_robots.given, "robots-given"),
    ("docs/robots_results.md", "robots_check", "robots_check", table_robots.check, "robots-check"),
    ("docs/robots_results.md", "sts3215", "sts3215", table_robots.changed, "sts3215"),
    ("docs/robots_results.md", "sts3215_bam", "sts3215_bam", table_robots.bam, "sts3215"),
    ("docs/wrist.md", "wrist", "wrist", wrist.wrist, "wrist"),
    ("docs/tables/wrist.csv", "", "wrist", partial(wrist.wrist, every=True), "wrist"),
    ("docs/sequences.md", "sequences", "sequences", sequences.table, "sequences"),
)


def fill(text: str, name: str, table: str) -> str:
    """Replace the text between the markers of `name` by a table; ValueError without markers."""
    pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"no markers <!-- {name} --> ... <!-- /{name} -->")
    return pattern.sub(lambda m: f"{m[1]}\n{table}\n\n{m[2]}", text)


def main() -> None:
    for file, name, results, make, _ in TABLES:
        found, path = [load(stem) for stem in results.split()], ROOT / file
        table = None if None in found else make(*found)
        if table is not None:
            whole = fill(path.read_text(encoding="utf-8"), name, table) if name else as_csv(table)
            path.write_text(whole, encoding="utf-8")
            print(f"{file}: {name}")


if __name__ == "__main__":
    main()
