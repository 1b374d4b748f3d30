"""Fill the tables of README.md and docs/ from the results that the experiments saved.

    python -m experiments.write_tables

Text between <!-- name --> and <!-- /name --> is replaced; what has no result yet stays as it is. Figures that
were drawn on the way get the commit that drew them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from experiments import (
    before_after,
    gap_arm,
    gap_drawn,
    patch_heldout,
    provenance,
    spent_sets,
    stamps,
    table_blind_check,
    table_calibration,
    table_gap,
    table_robots,
    table_sequences,
    table_speed,
    then_and_now,
    wrist,
)
from experiments.table_misfits import by_world, misfits, untidy
from experiments.table_real import real
from experiments.table_text import covered, load, markdown, milliseconds, percent
from hmmseg.contact.identifiability import PROPERTIES

ROOT = Path(__file__).parents[1]
PAPER = {"weight": "3 %", "width": "7 %", "height": "10 %"}
TARGET = {"weight": "<= 0.5 %", "width": "<= 0.1 %", "height": "<= 0.2 %"}

SETS = {
    "bank": "Virtual model, fresh seeds",
    "recordings": "Stand-in recordings, healthy",
    "systematic": "Hands that deviate as [systematic] says",
}


def results() -> str | None:
    """README: measured beside the targets and the paper's numbers."""
    found = load("calibration")
    if found is None or "recordings" not in found:
        return None
    columns = [found["recordings"]["pooled"], found["bank"]["pooled"]]
    head = ["", "to reach", "stand-in recordings", "virtual model, fresh seeds", "the paper"]
    b, p = [c["boundaries"]["all"] for c in columns], [c["properties"] for c in columns]
    rows = [
        ["healthy cases (of four trials, pooled)", "", *(f"{c['estimates']}" for c in columns), ""],
        ["boundary error, median", "<= 15 ms", *(milliseconds(x["median"]) for x in b), ""],
        ["boundary error, 95th percentile", "<= 50 ms", *(milliseconds(x["percentile_95"]) for x in b), ""],
        ["90 % boundary intervals cover", "87-93 %", *(covered(x, "coverage_90") for x in b), "none given"],
    ]
    for key in PROPERTIES:
        rms = [percent(x[key]["rms"], 2) for x in p]
        rows.append([f"{key}, rms relative error", TARGET[key], *rms, PAPER[key]])
    for level, target in (("95", "92-97 %"), ("68", "63-73 %")):
        cells = [covered(x["all"], f"coverage_{level}") for x in p]
        rows.append([f"{level} % property intervals cover", target, *cells, "none given"])
    speed = load("benchmark_commands")
    if speed is not None:
        text = f"{speed['commands']['identify']['warm']:.1f} s of processor"
        rows.append(["`hmmseg identify`, one trial, warm cache", "<= 6 s", text, "", ""])
    single = [found["recordings"]["single"], found["bank"]["single"]]
    rms = [", ".join(percent(c["properties"][k]["rms"], 2) for k in PROPERTIES) for c in single]
    rows.append(["weight, width, height from a single trial", "", *rms, ""])
    note = "Coverages with their standard error over cases; the paper has one recording, so no coverage."
    return f"{markdown(head, rows)}\n\n{note}"


def rivals() -> str | None:
    """docs/results.md: the switching model beside the paper's method, on every recording of the folder."""
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


def ablation() -> str | None:
    """docs/calibration.md: errors and coverages with one part left out."""
    found = load("ablation")
    if found is None:
        return None
    rows = []
    for v in found["variants"]:
        b, p = v["boundaries"]["all"], v["properties"]
        times = [milliseconds(b["median"]), milliseconds(b["percentile_95"]), percent(b["coverage_90"])]
        rms = [percent(p[k]["rms"], 3) for k in PROPERTIES]
        rows.append([v["name"], *times, *rms, percent(p["all"]["coverage_95"])])
    head = [
        "",
        "boundary, median",
        "95th percentile",
        "90 % intervals cover",
        *PROPERTIES,
        "95 % intervals cover",
    ]
    note = (f"{found['cases']} cases of four pooled trials; weight, width and height: rms relative error. "
            "Knocked: 2 % of all force samples are off by up to 0.5 N.")  # fmt: skip
    return f"{markdown(head, rows)}\n\n{note}"


def calibration() -> str | None:
    """docs/calibration.md: coverages by kind of boundary and property, and Laplace beside sampling."""
    found = load("calibration")
    if found is None:
        return None
    parts = []
    for name, title in SETS.items():
        if name not in found:
            continue
        for size, of in (("pooled", "four trials pooled"), ("single", "single trials")):
            s = found[name][size]
            parts.append(f"### {title}: {of} ({s['estimates']} estimates)")
            head = ["boundary", "number", "shift", "median error", "95th percentile", "90 % intervals cover"]
            rows = []
            for kind, b in s["boundaries"].items():
                times = [milliseconds(b[k]) for k in ("bias", "median", "percentile_95")]
                rows.append([kind, f"{b['count']}", *times, covered(b, "coverage_90")])
            parts.append(markdown(head, rows))
            head = ["property", "number", "rms error", "68 % cover", "Laplace", "95 % cover", "Laplace"]
            rows = []
            for key, p in s["properties"].items():
                shares = ("coverage_68", "laplace_68", "coverage_95", "laplace_95")
                rows.append([key, f"{p['count']}", percent(p["rms"], 3), *(covered(p, c) for c in shares)])
            parts.append(markdown(head, rows))
    return "\n\n".join(parts)


def moves() -> str | None:
    """docs/calibration.md: the sampler's moves."""
    found = load("benchmark_moves")
    if found is None:
        return None
    rows = []
    for size, of in found["trials"].items():
        for name, row in of.items():
            tau, speed = f"{row['autocorrelation_time']:.1f}", f"{row['ess_per_second']:.0f}"
            rows.append([name, size, f"{row['acceptance']:.2f}", tau, speed])
    head = ["moves", "trials", "acceptance", "autocorrelation time", "effective samples a second"]
    return markdown(head, rows)


# Page, name of the table on it, what writes it, and the make target that makes its numbers anew.
TABLES: tuple[tuple[str, str, Callable[[], str | None], str], ...] = (
    ("README.md", "results", results, "results"),
    ("docs/results.md", "results", results, "results"),
    ("docs/results.md", "rivals", rivals, "results"),
    ("docs/results.md", "real", real, "real"),
    ("docs/calibration.md", "ablation", ablation, "results"),
    ("docs/calibration.md", "calibration", calibration, "results"),
    ("docs/calibration.md", "identified", table_calibration.identified, "identified"),
    ("docs/calibration.md", "identified_boundaries", table_calibration.boundaries, "identified"),
    ("docs/calibration.md", "worlds", table_calibration.worlds, "calibrate"),
    ("docs/calibration.md", "sbc", table_calibration.sbc, "calibrate"),
    ("docs/calibration.md", "reference", table_calibration.reference, "calibrate"),
    ("docs/calibration.md", "moves", moves, "results"),
    ("docs/calibration.md", "misfits", misfits, "results"),
    ("docs/calibration.md", "misfits_by_world", by_world, "untidy"),
    ("docs/calibration.md", "untidy", untidy, "untidy"),
    ("docs/calibration.md", "then_and_now", then_and_now.table, "then-and-now"),
    ("docs/results.md", "gap", table_gap.summary, "gap-results"),
    ("docs/gap_results.md", "recordings", table_gap.recordings, "gap-results"),
    ("docs/gap_results.md", "patch", patch_heldout.table, "gap-results"),
    ("docs/gap_results.md", "drawn", gap_drawn.table, "gap-drawn"),
    ("docs/gap_results.md", "arm", gap_arm.table, "gap-arm"),
    ("docs/gap_results.md", "blind", table_blind_check.table, "blind-check"),
    ("docs/history.md", "blind_sets", spent_sets.table, "blind-check"),
    ("README.md", "kernels", table_speed.kernels_short, "bench"),
    ("docs/benchmarks.md", "kernels", table_speed.kernels, "bench"),
    ("docs/benchmarks.md", "smoothing", table_speed.smoothing, "bench"),
    ("docs/benchmarks.md", "samplers", table_speed.samplers, "results"),
    ("docs/benchmarks.md", "commands", table_speed.commands, "bench"),
    ("docs/benchmarks.md", "batch", table_speed.batch, "bench-batch"),
    ("docs/virtual_model.md", "haptic", table_speed.haptic, "bench-haptic"),
    ("docs/benchmarks.md", "lengths", table_speed.lengths, "bench-long"),
    ("docs/benchmarks.md", "solvers", table_speed.solvers, "bench-solvers"),
    ("docs/watch.md", "watch", table_speed.watch, "bench-watch"),
    ("docs/robots_results.md", "minute", table_robots.minute, "bench-robot"),
    ("docs/robots_results.md", "robots_check", table_robots.check, "robots-check"),
    ("docs/wrist.md", "wrist", wrist.wrist, "wrist"),
    ("docs/sequences.md", "sequences", table_sequences.table, "sequences"),
    ("docs/before_after.md", "before_after", before_after.table, "before-after"),
)


def targets() -> str:
    """docs/architecture.md: what each make target makes."""
    return provenance.table((page, name, target) for page, name, _, target in TABLES)


def fill(text: str, name: str, table: str) -> str:
    """Text with what stands between the markers of `name` replaced; ValueError without markers."""
    pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"no markers <!-- {name} --> ... <!-- /{name} -->")
    return pattern.sub(lambda m: f"{m[1]}\n{table}\n\n{m[2]}", text)


def main() -> None:
    pages = [(page, name, make) for page, name, make, _ in TABLES]
    for file, name, make in [*pages, ("docs/architecture.md", "targets", targets)]:
        table, path = make(), ROOT / file
        if table is not None:
            path.write_text(fill(path.read_text(encoding="utf-8"), name, table), encoding="utf-8")
            print(f"{file}: {name}")
    stamps.main()


if __name__ == "__main__":
    main()
