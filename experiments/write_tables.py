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
    gap_drawn,
    gap_recordings,
    table_calibration,
    table_robots,
    table_sequences,
    table_speed,
    wrist,
)
from experiments.blind_check import tables as blind_check
from experiments.real import hiro_snap
from experiments.table_text import as_csv, covered, load, markdown, milliseconds, percent
from hmmseg.contact.decompose import PROPERTIES

ROOT = Path(__file__).parents[1]
PAPER = {"weight": "3 %", "width": "7 %", "height": "10 %"}


def headline() -> str | None:
    """README: errors and coverage on two kinds of recordings, in four rows."""
    found = load("calibration")
    if found is None or "recordings" not in found:
        return None
    columns = [found["recordings"]["pooled"], found["bank"]["pooled"]]
    b, p = [c["boundaries"]["all"] for c in columns], [c["properties"] for c in columns]
    rows = [
        ["boundary error, median", *(milliseconds(x["median"]) for x in b)],
        ["90 % boundary intervals cover", *(covered(x, "coverage_90") for x in b)],
        [", ".join(PROPERTIES), *(", ".join(percent(x[k]["rms"], 2) for k in PROPERTIES) for x in p)],
        ["95 % property intervals cover", *(covered(x["all"], "coverage_95") for x in p)],
    ]
    cases = [f"{c['estimates']}" for c in columns]
    table = markdown(["", f"recordings ({cases[0]} cases)", f"virtual model ({cases[1]} cases)"], rows)
    return f"{table}\n\nFour trials a case; properties: rms relative error."


def results() -> str | None:
    """docs/results.md: what was measured on two kinds of recordings; the paper's numbers below."""
    found = load("calibration")
    if found is None or "recordings" not in found:
        return None
    columns = [found["recordings"]["pooled"], found["bank"]["pooled"]]
    b, p = [c["boundaries"]["all"] for c in columns], [c["properties"] for c in columns]
    rows = [
        ["healthy cases (of four trials, pooled)", *(f"{c['estimates']}" for c in columns)],
        ["boundary error, median", *(milliseconds(x["median"]) for x in b)],
        ["boundary error, 95th percentile", *(milliseconds(x["percentile_95"]) for x in b)],
        ["90 % boundary intervals cover", *(covered(x, "coverage_90") for x in b)],
    ]
    rows += [[f"{key}, rms relative error", *(percent(x[key]["rms"], 2) for x in p)] for key in PROPERTIES]
    for level in ("95", "68"):
        cells = [covered(x["all"], f"coverage_{level}") for x in p]
        rows.append([f"{level} % property intervals cover", *cells])
    single = [found["recordings"]["single"], found["bank"]["single"]]
    rms = [", ".join(percent(c["properties"][k]["rms"], 2) for k in PROPERTIES) for c in single]
    rows.append(["weight, width, height from a single trial", *rms])
    theirs = ", ".join(f"{key} {PAPER[key]}" for key in PROPERTIES)
    note = (
        f"Coverages with their standard error over cases. The paper's own errors, of one recording: {theirs}."
    )
    speed = load("benchmark_commands")
    if speed is not None:
        seconds = speed["commands"]["identify"]["warm"]
        note += f" `hmmseg identify` of one trial takes {seconds:.1f} s of processor."
    note += f" Code of {found['made_by']}."
    head = ["", "stand-in recordings", "virtual model, fresh seeds"]
    return f"{markdown(head, rows)}\n\n{note}"


def rivals() -> str | None:
    """docs/results.md: the model against the paper's method, on every recording."""
    methods = {"hmm": "this model", "qualitative": "thresholds, best monotone order",
               "first-change": "thresholds, first change (the paper)"}  # fmt: skip
    rows = []
    for name, label in methods.items():
        found = load(f"score_{name}")
        if found is None:
            return None
        for group in ("healthy", "all"):
            s = found["summary"][group]
            b, p = s["boundaries"], s["properties"]
            rms = [percent(p[k]["rms"], 2) if "rms" in p[k] else "none" for k in PROPERTIES]
            times = [milliseconds(b[k]) if b[k] is not None else "none" for k in ("median", "percentile_95")]
            rows.append([label, group, f"{s['complete']} of {s['trials']}", *times, *rms])
    head = ["method", "recordings", "trials complete", "boundary, median", "95th percentile", *PROPERTIES]
    return markdown(head, rows)


# Page, name of the table on it (none: it is the whole file), what writes it, and the target of its numbers.
TABLES: tuple[tuple[str, str, Callable[[], str | None], str], ...] = (
    ("README.md", "results", headline, "results"),
    ("docs/results.md", "results", results, "results"),
    ("docs/results.md", "rivals", rivals, "results"),
    ("docs/results.md", "real", hiro_snap.table, "real"),
    ("docs/tables/calibration.csv", "", table_calibration.calibration, "results"),
    ("docs/tables/worlds.csv", "", table_calibration.worlds, "calibrate"),
    ("docs/tables/sbc.csv", "", table_calibration.sbc, "calibrate"),
    ("docs/results.md", "gap", gap_recordings.in_short, "gap-results"),
    ("docs/gap_results.md", "recordings", gap_recordings.table, "gap-results"),
    ("docs/gap_results.md", "labs", gap_drawn.table, "gap-labs"),
    ("docs/gap_results.md", "blind", blind_check.blind, "blind-check"),
    ("docs/tables/blind.csv", "", blind_check.by_circumstance, "blind-check"),
    ("docs/benchmarks.md", "commands", table_speed.commands, "bench"),
    ("docs/virtual_model.md", "haptic", table_speed.haptic, "bench-haptic"),
    ("docs/watch.md", "watch", table_speed.watch, "bench-watch"),
    ("docs/robots_results.md", "minute", table_robots.minute, "bench-robot"),
    ("docs/robots_results.md", "robots_check_given", table_robots.given, "robots-given"),
    ("docs/robots_results.md", "robots_check", table_robots.check, "robots-check"),
    ("docs/robots_results.md", "sts3215", table_robots.changed, "sts3215"),
    ("docs/robots_results.md", "sts3215_bam", table_robots.bam, "sts3215"),
    ("docs/wrist.md", "wrist", wrist.wrist, "wrist"),
    ("docs/tables/wrist.csv", "", partial(wrist.wrist, every=True), "wrist"),
    ("docs/sequences.md", "sequences", table_sequences.table, "sequences"),
)


def fill(text: str, name: str, table: str) -> str:
    """Text with what stands between the markers of `name` replaced; ValueError without markers."""
    pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"no markers <!-- {name} --> ... <!-- /{name} -->")
    return pattern.sub(lambda m: f"{m[1]}\n{table}\n\n{m[2]}", text)


def main() -> None:
    for file, name, make, _ in TABLES:
        table, path = make(), ROOT / file
        if table is not None:
            whole = fill(path.read_text(encoding="utf-8"), name, table) if name else as_csv(table)
            path.write_text(whole, encoding="utf-8")
            print(f"{file}: {name}")


if __name__ == "__main__":
    main()
