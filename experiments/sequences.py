"""Plain sequences without labels: accuracy and calibration of boundaries, and the effect of one label.

    python -m experiments.sequences check [--worlds N] [--seed S] [--real FOLDER] [--panda FOLDER]
    python -m experiments.sequences learn [--worlds N] [--seed S]

`check` segments drawn worlds (experiments/sequence_worlds.py), and published snap assemblies and a simulated
arm's wrist signals where their folders are given: without labels; with the one boundary that the tool asks
for; with one labelled trial. Writes experiments/results/sequences.json. `learn` finds what weighs readings
(hmmseg.sequence.courses.Weighing) by maximum likelihood on other drawn worlds.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from experiments.real import hiro_snap
from experiments.saving import panels, save
from experiments.sequence_worlds import World, abrupt, draw
from experiments.table_text import markdown, percent
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import Segmentation, most_telling
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.segment import segment_sequence

OUT = Path(__file__).parent / "results" / "sequences.json"
FIGURE = Path(__file__).parents[1] / "docs" / "figures" / "sequences.png"
ROWS = {"none": "no labels", "asked": "the suggested label", "trial": "one labelled trial"}
WRIST = ("width", "ee_y", "ee_z", "Fx", "Fy", "Fz")
LEARNED_FROM = 80_000  # chosen: first seed of the worlds that weights are learned from
MOST_TRIALS = 4  # numerics: of a hand's recordings
BINS = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 0.95, 1.01)


@dataclass(frozen=True)
class Case:
    """Trials with true boundaries; `scored` are the indices of the known ones."""

    name: str
    group: str
    world: World
    scored: tuple[int, ...]


def drawn(first: int, count: int) -> list[Case]:
    """Newly drawn worlds: of many kinds, and with abrupt changes only."""
    cases = []
    for group, make in (("drawn", draw), ("abrupt", abrupt)):
        for seed in range(first, first + count):
            world = make(seed)
            cases.append(Case(f"{group} {seed}", group, world, tuple(range(len(world.task.sequence) - 1))))
    return cases


def snaps(folder: Path) -> list[Case]:
    """Published snap assemblies, cropped at random."""
    cases = []
    for kind, description in hiro_snap.KINDS.items():
        trials = hiro_snap.read_kind(folder, kind)
        for heard, channels in (("wrench", hiro_snap.WRENCH), ("wrench and pose", hiro_snap.WRENCH_AND_POSE)):
            rng = np.random.default_rng(0)
            cut = [hiro_snap.cropped(trial, rng.uniform(0, hiro_snap.MAX_CROP)) for trial, _ in trials]
            task = SequenceTask(description.sequence, channels)
            world = World(task, cut, [np.asarray(labels) for _, labels in trials])
            scored = tuple(range(len(task.sequence) - 1)[b] for b in description.scored)
            cases.append(Case(f"{kind}, {heard}", "snap assemblies", world, scored))
    return cases


def wrists(folder: Path) -> list[Case]:
    """A simulated arm that restacks two blocks, by its gripper's opening, place and wrist forces."""
    cases = []
    for each in sorted(folder.glob("wrist_*")):
        files = sorted(each.glob("wrist_[0-9]*.csv"))
        labels = [each / "truth" / f"trial_{file.stem[-2:]}.json" for file in files]
        if not files or not all(path.exists() for path in labels):
            continue
        truth = [np.array(json.loads(path.read_text())["boundaries"]) for path in labels]
        task = SequenceTask(tuple(f"subtask {i}" for i in range(truth[0].size + 1)), WRIST)
        world = World(task, [Trial.read(file, task=task) for file in files], truth)
        cases.append(Case(each.name, "arm's wrist", world, tuple(range(truth[0].size))))
    return cases


def hands(folders: list[Path]) -> list[Case]:
    """Block recordings of a two-finger hand, with all their raw channels, four trials of each."""
    cases = []
    for each in folders:
        files = sorted(each.glob("trial_*.csv"))[:MOST_TRIALS]
        labels = [each / "truth" / f"{file.stem}.json" for file in files]
        truth = [np.array(json.loads(path.read_text())["boundaries"]) for path in labels]
        task = SequenceTask(tuple(f"subtask {i}" for i in range(truth[0].size + 1)))
        world = World(task, [Trial.read(file, task=task) for file in files], truth)
        cases.append(Case(each.name, "hand", world, tuple(range(truth[0].size))))
    return cases


def answers(case: Case) -> dict:
    """Scores without labels, with the one suggested label, and with one labelled trial."""
    world = case.world
    model = fit_sequence(world.trials, world.task)
    blind = segment_sequence(world.trials, world.task, model)
    out = {"name": case.name, "group": case.group, "none": score(case, blind), "asked": None}
    question = most_telling(blind)
    if question is not None:
        i = [trial.file for trial in world.trials].index(question.trial)
        b = world.task.sequence.index(question.subtask) - 1
        labels = {world.trials[i].name: {question.subtask: float(world.boundaries[i][b])}}
        model = fit_sequence(world.trials, world.task, labels)
        again = segment_sequence(world.trials, world.task, model)
        out["asked"] = score(case, again, without=i)
        out["gain"] = question.gain
    labels = {world.trials[0].name: world.boundaries[0].tolist()}
    taught = segment_sequence(world.trials, world.task, fit_sequence(world.trials, world.task, labels))
    out["trial"] = score(case, taught, without=0)
    return out


def score(case: Case, found: list[Segmentation], without: int | None = None) -> dict:
    """Errors as shares of the trial, coverage, and stated probabilities of places; one entry per boundary.

    `place`: probability of the place given, and whether the truth is nearer to it than to any other (within
    its 90 % interval's width of 2 % of the trial at least); `listed`: the truth is at one of these places.
    """
    rows = []
    for i, (segmentation, trial, truth) in enumerate(
        zip(found, case.world.trials, case.world.boundaries, strict=True)
    ):
        if i == without:
            continue
        length = float(trial.t[-1] - trial.t[0])
        starts = {span.subtask: span for span in segmentation.spans}
        for b in case.scored:
            span = starts.get(case.world.task.sequence[b + 1])
            if span is None:
                continue
            places = [(p.time, p.probability) for p in span.alternatives] or [(span.start, 1.0)]
            near = [abs(time - truth[b]) <= 0.03 * length for time, _ in places]
            rows.append({
                "error": (span.start - truth[b]) / length, "samples": (span.start - truth[b]) * trial.rate,
                "in_90": bool(span.start_90[0] <= truth[b] <= span.start_90[1]),
                "width": (span.start_90[1] - span.start_90[0]) / length,
                "places": [[p, bool(n)] for (_, p), n in zip(places, near, strict=True)],
            })  # fmt: skip
    return {"boundaries": rows}


def summary(scores: list[dict]) -> dict:
    """Summary over all boundaries of some cases."""
    rows = [row for each in scores for row in each["boundaries"]]
    if not rows:
        return {}
    error = np.abs([row["error"] for row in rows])
    silent = [row for row in rows if len(row["places"]) == 1]
    places = np.array([pair for row in rows for pair in row["places"]], dtype=float)
    reliability = []
    for low, high in pairwise(BINS):
        inside = (places[:, 0] >= low) & (places[:, 0] < high)
        if inside.any():
            said, true = places[inside].mean(0).tolist()
            reliability.append({"said": said, "true": true, "count": int(inside.sum())})
    return {
        "boundaries": len(rows), "median": float(np.median(error)), "right": float((error <= 0.03).mean()),
        "within_a_sample": float(np.mean([abs(row["samples"]) <= 1 for row in rows])),
        "coverage_90": float(np.mean([row["in_90"] for row in rows])),
        "width": float(np.median([row["width"] for row in rows])),
        "listed": float(np.mean([any(n for _, n in row["places"]) for row in rows])),
        "sure": len(silent) / len(rows),
        "sure_right": float(np.mean([abs(row["error"]) <= 0.03 for row in silent])) if silent else None,
        "reliability": reliability,
    }  # fmt: skip


def check(cases: list[Case]) -> dict:
    """Score all cases, printing each."""
    rows = []
    for case in cases:
        row = answers(case)
        rows.append(row)
        text = [
            f"{kind} {s['median']:.1%} off, {s['right']:.0%} right, {s['coverage_90']:.0%} held"
            for kind in ("none", "asked", "trial")
            if row[kind] is not None and (s := summary([row[kind]]))
        ]
        print(f"{case.name}: {'; '.join(text)}", flush=True)
    groups: dict = {}
    for group in dict.fromkeys(case.group for case in cases):
        mine = [row for row in rows if row["group"] == group]
        groups[group] = {
            kind: summary([row[kind] for row in mine if row[kind] is not None])
            for kind in ("none", "asked", "trial")
        } | {"cases": len(mine), "questions": sum(row["asked"] is not None for row in mine)}
        open_ = [row for row in mine if row["asked"] is not None]
        groups[group]["before_asked"] = summary([row["none"] for row in open_])
    each = [
        {"name": row["name"], "group": row["group"]}
        | {kind: summary([row[kind]]) for kind in ("none", "asked", "trial") if row[kind]}
        for row in rows
    ]
    return {"groups": groups, "cases": each}


def table(found: dict) -> str:
    """A row for each group of cases and kind of labels; draws the figure."""
    rows = []
    for group, entry in found["groups"].items():
        for key, label in ROWS.items():
            s = entry[key]
            if not s:
                continue
            sure = "" if s["sure_right"] is None else percent(s["sure_right"], 0)
            shares = [percent(s[k], 0) for k in ("right", "within_a_sample", "listed", "coverage_90")]
            cells = [f"{s['boundaries']}", percent(s["median"]), *shares, percent(s["width"])]
            rows.append([group, label, *cells, percent(s["sure"], 0), sure])
    _draw(found["groups"], FIGURE)
    head = ["cases", "known", "boundaries", "median error", "right", "within a sample",
            "truth at a listed place", "90 % intervals hold", "their width", "one place only",
            "of these right"]  # fmt: skip
    note = (
        f"{found['worlds']} worlds drawn of many kinds, as many of levels that jump in white noise (abrupt). "
        "Errors and widths as shares of the trial. The labelled trial is not scored."
    )
    return f"{markdown(head, rows)}\n\n{note}"


def _draw(groups: dict[str, Any], path: Path) -> None:
    """Plot reliability: stated probability of places without labels against the share that were true."""
    with panels(path, figsize=(4.2, 4.0)) as ax:
        ax.plot([0, 1], [0, 1], color="0.6", lw=0.8)
        for group, entry in groups.items():
            bins = entry["none"]["reliability"]
            ax.plot([b["said"] for b in bins], [b["true"] for b in bins], "-", lw=0.8, label=group)
            ax.scatter(
                [b["said"] for b in bins],
                [b["true"] for b in bins],
                s=[3 + 40 * b["count"] / max(each["count"] for each in bins) for b in bins],
            )
        ax.set_xlabel("probability said of a place")
        ax.set_ylabel("share that were true")
        ax.legend(fontsize=8)


def main() -> None:
    """Check or learn, print, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("check", "learn"))
    parser.add_argument("--worlds", type=int, default=12)
    parser.add_argument("--seed", type=int, default=117_000)
    parser.add_argument("--real", type=Path, help="folder of hiro_snap")
    parser.add_argument("--panda", type=Path, help="folder of a simulated arm's recordings")
    parser.add_argument("--hands", type=Path, nargs="*", default=[], help="folders of a hand's recordings")
    args = parser.parse_args()
    if args.what == "learn":
        from experiments.sequence_weighing import learn

        learn([draw(seed) for seed in range(LEARNED_FROM, LEARNED_FROM + args.worlds)])
        return
    cases = drawn(args.seed, args.worlds)
    cases += snaps(args.real) if args.real else []
    cases += wrists(args.panda) if args.panda else []
    cases += hands(args.hands)
    document = check(cases)
    for group, entry in document["groups"].items():
        for kind in ("none", "before_asked", "asked", "trial"):
            values = {k: v for k, v in entry[kind].items() if k != "reliability" and v is not None}
            print(group, kind, {k: round(float(v), 3) for k, v in values.items()})
        print([(round(r["said"], 2), round(r["true"], 2), r["count"]) for r in entry["none"]["reliability"]])
    save(OUT, {"worlds": args.worlds, "seed": args.seed} | document)


if __name__ == "__main__":
    main()
