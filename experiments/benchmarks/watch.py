"""Following a task while it runs: time a row, accuracy against lag and off line, agreement, false alarms.

    python -m experiments.benchmarks.watch FOLDER...

FOLDERs hold cases (rig.toml, task.toml, trial_*.csv, truth/). Writes experiments/results/watch.json and
docs/figures/watch_lag.png. Ten minutes at 1 kHz are the fastest case's rows, performed again and again
(`repeat`), as a real stream would be. Processor times include parsing rows and writing lines.
"""

from __future__ import annotations

import argparse
import gc
import io
import json
import resource
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.recordings import list_cases, read_boundaries
from experiments.saving import save
from experiments.table_text import markdown, percent
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, Task
from hmmseg.io.trial import Trial
from hmmseg.online.watcher import Watcher
from hmmseg_cli.rows import Rows

OUT = Path(__file__).parents[1] / "results" / "watch.json"
FIGURE = Path(__file__).parents[2] / "docs" / "figures" / "watch_lag.png"
LAGS = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
MINUTES = 10


def rows_of(case: Path, file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Times and channels of one recording, as a watcher takes them."""
    rig = Rig.read(case / "rig.toml")
    trial = Trial.read(file, rig)
    names = Watcher(case / "task.toml", rig).channels
    missing = np.full(trial.t.size, np.nan)
    return trial.t, np.stack([trial.channels.get(name, missing) for name in names], axis=1)


def timing(case: Path) -> dict:
    """A stream of MINUTES at the recording's rate: its rows again and again, each a round of the task."""
    rig, task = Rig.read(case / "rig.toml"), Task.read(case / "task.toml")
    assert isinstance(task, BlockTask)
    lines = (sorted(case.glob("trial_*.csv"))[0]).read_text().splitlines()
    t = np.array([float(line.split(",", 1)[0]) for line in lines[1:]])
    rest = [line.split(",", 1)[1] for line in lines[1:]]
    step = float(np.median(np.diff(t)))
    rounds = int(np.ceil(MINUTES * 60 / (t[-1] - t[0] + step)))
    text = "\n".join([lines[0], *(f"{at + r * (t[-1] - t[0] + step):.6f},{row}" for r in range(rounds)
                                  for at, row in zip(t, rest, strict=True))]).encode()  # fmt: skip
    watcher = Watcher(replace(task, repeat="unknown"), rig)
    rows, out = Rows(io.BytesIO(text), watcher), io.StringIO()
    taken, memory = [], []
    gc.collect()
    gc.disable()
    while True:
        began = time.process_time_ns()
        row = rows.next()
        if row is None:
            break
        out.write(watcher.update(*row).line() + "\n")
        out.flush()
        taken.append(time.process_time_ns() - began)
        if len(taken) % 60000 == 0:
            memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
            out.seek(0)
            out.truncate()
    gc.enable()
    us = np.array(taken[100:]) / 1e3
    return {
        "rows": len(taken), "rate": 1 / step, "median_us": float(np.median(us)),
        "q999_us": float(np.quantile(us, 0.999)), "worst_us": float(us.max()),
        "within_1ms": float((us <= 1000).mean()), "memory_mb": memory,
    }  # fmt: skip


def boundaries(case: Path, file: Path, lag: float) -> tuple[list, bool, bool]:
    """Settled boundaries (t, sd), whether an earlier row was reported as not fitting, and the last
    verdict."""
    watcher, alarm = Watcher(case / "task.toml", case / "rig.toml", lag), False
    for t, row in zip(*rows_of(case, file), strict=True):
        alarm |= not watcher.update(float(t), row).fits
    settled = [(c.t, c.sd) for c in watcher.crossings]
    final = watcher.finish()
    settled += [(c.t, c.sd) for c in watcher.crossings[len(settled) :]]
    return settled, alarm, final.fits


def off_line(case: Path, file: Path) -> tuple[list, bool]:
    """The same from the whole recording, analysed alone."""
    from hmmseg.api import segment

    found = segment(file, case / "task.toml", case / "rig.toml")[0]
    return [(s.start, s.start_sd) for s in found.spans[1:]], found.complete


def properties_of(case: Path, file: Path) -> list[float]:
    """Errors of the last answer's properties in standard deviations of both, against actual.toml."""
    watcher = Watcher(case / "task.toml", case / "rig.toml")
    for t, row in zip(*rows_of(case, file), strict=True):
        watcher.update(float(t), row)
    actual = tomllib.loads((case / "actual.toml").read_text())
    out = []
    for name, prop, mean, sd in watcher.finish().properties:
        known = actual.get(name, {}).get(prop)
        if prop == "weight" and known is not None:
            out.append((mean - known["value"]) / np.hypot(sd, known["sd"]))
    return out


def summary(errors: list[tuple[float, float]]) -> dict:
    """Median and 90 % of |error| [ms], and the share within two standard deviations."""
    e, sd = np.array(errors).T
    return {
        "boundaries": len(errors), "median_ms": float(1e3 * np.median(np.abs(e))),
        "q90_ms": float(1e3 * np.quantile(np.abs(e), 0.9)),
        "within_2_sd": float((np.abs(e) <= 2 * sd).mean()),
    }  # fmt: skip


def table(found: dict) -> str:
    """docs/watch.md: what `make bench-watch` measured."""
    time, lag, apart = found["timing"], found["by_lag"], found["apart_from_off_line"]
    rows = [
        [f"{time['rows']:,} rows at {time['rate']:.0f} Hz, processor a row, median",
         f"{time['median_us']:.0f} µs"],
        ["... 99.9 % of rows within", f"{time['q999_us']:.0f} µs"],
        ["... rows within 1 ms", percent(time["within_1ms"], 2)],
        ["... growth of memory over the last eight minutes",
         f"{time['memory_mb'][-1] - time['memory_mb'][1]:.0f} MB"],
        ["error of a boundary at a lag of 1 s, median and 90 %",
         f"{lag['1.0']['median_ms']:.1f} and {lag['1.0']['q90_ms']:.1f} ms"],
        ["... of the whole recording off line",
         f"{lag['off line']['median_ms']:.1f} and {lag['off line']['q90_ms']:.1f} ms"],
        ["boundaries within two standard deviations of the truth (off line)",
         f"{percent(lag['1.0']['within_2_sd'], 0)} ({percent(lag['off line']['within_2_sd'], 0)})"],
        ["... and of those off line, of both", percent(apart["within_2_sd"], 0)],
        ["weights within two standard deviations of the truth",
         f"{percent(found['weight_within_2_sd'], 0)} of {found['weights']}"],
        ["last verdict (fits or not) as off line",
         f"{found['same_verdict']} of {found['recordings']} recordings"],
        ["fitting recordings with a passing false alarm", f"{len(found['alarms_on_fitting'])}"],
    ]  # fmt: skip
    return markdown(["", "measured"], rows)


def main() -> None:
    """Measure, write, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--trials", type=int, default=1, help="recordings of each case")
    args = parser.parse_args()
    cases = [c for folder in args.folders for c in list_cases(folder) if (c / "rig.toml").exists()]
    chosen = [(c, f) for c in cases for f in sorted(c.glob("trial_*.csv"))[: args.trials]]
    by_lag: dict[str, list] = {str(lag): [] for lag in (*LAGS, "off line")}
    verdicts, apart, weights = [], [], []
    for case, file in chosen:
        true = read_boundaries(case / "truth" / f"{file.stem}.json")
        whole, complete = off_line(case, file)
        record = {"case": case.name, "off_line": complete}
        for lag in LAGS:
            found, alarm, fits = boundaries(case, file, lag)
            if lag == 1.0:
                record |= {"alarm": bool(alarm), "fits": bool(fits)}
            if true is None or not complete or len(found) != len(true) or np.isnan(true).any():
                continue
            by_lag[str(lag)] += [(t - b, sd) for (t, sd), b in zip(found, true, strict=True)]
            if lag == 1.0:
                by_lag["off line"] += [(t - b, sd) for (t, sd), b in zip(whole, true, strict=True)]
                apart += [(a - b, np.hypot(s, r)) for (a, s), (b, r) in zip(found, whole, strict=True)]
                weights += properties_of(case, file)
        verdicts.append(record)
        print(record, flush=True)
    fast = min(cases, key=lambda c: np.median(np.diff(rows_of(c, sorted(c.glob("trial_*.csv"))[0])[0])))
    agreed = [v for v in verdicts if v["fits"] == v["off_line"]]
    document = {
        "timing": timing(fast), "by_lag": {k: summary(v) for k, v in by_lag.items() if v},
        "apart_from_off_line": summary(apart), "weight_within_2_sd": float((np.abs(weights) <= 2).mean()),
        "weights": len(weights), "recordings": len(verdicts), "same_verdict": len(agreed),
        "alarms_on_fitting": [v["case"] for v in verdicts if v["off_line"] and v["alarm"]],
        "differing": [v["case"] for v in verdicts if v["fits"] != v["off_line"]],
    }  # fmt: skip
    save(OUT, document)
    draw(document["by_lag"])
    print(json.dumps(document, indent=1))


def draw(by_lag: dict) -> None:
    """Error of settled boundaries against the lag, and that of the whole recording."""
    from hmmseg.plot.style import canvas

    lags = [lag for lag in LAGS if str(lag) in by_lag]
    with canvas(FIGURE, 5.2, 3.2) as figure:
        axes = figure.subplots()
        for key, label, marker in (("median_ms", "median", "o-"), ("q90_ms", "90 % of boundaries", "s-")):
            line = axes.plot(lags, [by_lag[str(lag)][key] for lag in lags], marker, label=label)[0]
            axes.axhline(by_lag["off line"][key], color=line.get_color(), linestyle=":",
                         label=f"{label}, whole recording")  # fmt: skip
        axes.set(xlabel="lag [s]", ylabel="error of a boundary [ms]", yscale="log", xlim=(-0.005, 2.4))
        axes.set_xscale("symlog", linthresh=0.05)
        axes.set_xticks(lags, [f"{lag:g}" for lag in lags])
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=2)


if __name__ == "__main__":
    main()
