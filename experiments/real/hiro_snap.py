"""Snap assembly by a HIRO robot: boundaries found against the controller's labels.

    python -m experiments.real.hiro_snap FOLDER [--seeds N] [--output FILE.json]

FOLDER holds the published trials (Biomimetics and Intelligent Robotics Lab, REAL_HIRO_ONE_SA_SUCCESS;
one folder a trial with R_Torques.dat, R_CartPos.dat, R_State.dat, 200 Hz). The start of every trial is
cropped by a random 0-3 s, so that the time since the start gives nothing away. With labels: emissions
learned on one half of the trials, tested on the other, both ways. Without: learned from the trials
themselves.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.saving import save
from experiments.table_text import markdown
from hmmseg.errors import InputError
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import Segmentation
from hmmseg.sequence.fit import fit_sequence
from hmmseg.sequence.segment import segment_sequence

COLUMNS = {
    "R_Torques.dat": ("fx", "fy", "fz", "mx", "my", "mz"),
    "R_CartPos.dat": ("x", "y", "z", "roll", "pitch", "yaw"),
}
# Roll and yaw are left out: the wrist works at a pitch of -pi/2, where these angles are singular.
WRENCH_AND_POSE = ("fx", "fy", "fz", "mx", "my", "mz", "x", "y", "z", "pitch")
WRENCH = COLUMNS["R_Torques.dat"]
MAX_CROP = 3.0  # s
RESULTS = Path(__file__).resolve().parents[1] / "results" / "hiro_snap.json"
# Words of the table.
SHOWN = {"real_guarded": "guarded", "real_pivot": "pivoting"}
HEARD = {"wrench_and_pose": "force, torque and pose", "wrench": "force and torque alone"}
METHODS = {"with_labels": "labels of the other half", "without_labels": "no labels"}
CLOCKS = {
    "training_mean": "none: answers the training mean",
    "training_mean_uncropped": "the same, recordings not cropped",
}


@dataclass(frozen=True)
class Kind:
    """One kind of trial: its subtasks and which of the four labelled starts begin them."""

    sequence: tuple[str, ...]
    starts: tuple[int, ...]
    scored: tuple[int, int] = (0, -1)  # approach -> rotation, insertion -> mating


KINDS = {
    "real_guarded": Kind(("approach", "rotation", "insertion", "mating"), (1, 2, 3)),
    # Rotation hands over to insertion within 5 ms: one phase in effect.
    "real_pivot": Kind(("approach", "rotation and insertion", "mating"), (1, 3)),
    "sim": Kind(("approach", "rotation", "insertion", "mating"), (1, 2, 3)),
}


def read_trial(folder: Path) -> tuple[Trial, np.ndarray]:
    """A published trial and the start times [s] of its states; InputError for a malformed folder."""
    tables = {}
    for name in (*COLUMNS, "R_State.dat"):
        try:
            tables[name] = np.loadtxt(folder / name, ndmin=2)
        except (OSError, ValueError) as error:
            raise InputError(str(folder / name), f"cannot be read ({error})", "a table of numbers") from None
    count = min(len(tables[name]) for name in COLUMNS)
    t = tables["R_Torques.dat"][:count, 0]
    channels = {}
    for name, columns in COLUMNS.items():
        if tables[name].shape[1] != 7:
            raise InputError(str(folder / name), f"has {tables[name].shape[1]} columns", "t and six more")
        channels |= {column: tables[name][:count, j] for j, column in enumerate(columns, 1)}
    keep = np.r_[True, np.diff(t) > 0]  # the clock of one trial stutters
    trial = Trial(folder.name, t[keep], {name: x[keep] for name, x in channels.items()})
    return trial, tables["R_State.dat"].ravel()


def read_kind(folder: Path, kind: str) -> list[tuple[Trial, np.ndarray]]:
    """All trials of one kind with the labelled boundaries [s] of its task."""
    trials = []
    for each in sorted(path for path in (folder / kind).iterdir() if path.is_dir()):
        trial, starts = read_trial(each)
        if starts.size < 4:
            raise InputError(str(each / "R_State.dat"), f"has {starts.size} starts", "four")
        trials.append((trial, starts[list(KINDS[kind].starts)]))
    return trials


def cropped(trial: Trial, seconds: float) -> Trial:
    """The trial without its first seconds."""
    keep = trial.t >= trial.t[0] + seconds
    return Trial(trial.file, trial.t[keep], {name: x[keep] for name, x in trial.channels.items()})


def _scored(result: Segmentation, kind: Kind, labels: np.ndarray) -> dict:
    """Signed differences found - label [s] and interval hits at the two scored boundaries."""
    spans = result.spans
    rows = {"trial": result.file, "complete": result.complete, "difference": [], "in_90": [], "sd": []}
    for b in kind.scored:
        span = spans[1:][b]
        rows["difference"].append(span.start - float(labels[b]))
        rows["in_90"].append(bool(span.start_90[0] <= labels[b] <= span.start_90[1]))
        rows["sd"].append(span.start_sd)
    return rows


def with_labels(trials: list, kind: Kind, channels: tuple[str, ...], seed: int) -> tuple[list, list]:
    """Two-fold: rows of the segmentation and of the predictor that answers the training mean."""
    rng = np.random.default_rng(seed)
    data = [(cropped(trial, rng.uniform(0, MAX_CROP)), labels) for trial, labels in trials]
    order = rng.permutation(len(data))
    halves = order[: len(data) // 2], order[len(data) // 2 :]
    task = SequenceTask(kind.sequence, channels)
    rows, clock = [], []
    for train, test in (halves, halves[::-1]):
        model = fit_sequence([data[i][0] for i in train], task, {data[i][0].file: data[i][1] for i in train})
        results = segment_sequence([data[i][0] for i in test], task, model)
        rows += [_scored(result, kind, data[i][1]) for result, i in zip(results, test, strict=True)]
        since_start = np.mean([labels - trial.t[0] for trial, labels in (data[i] for i in train)], 0)
        for i in test:
            error = since_start + data[i][0].t[0] - data[i][1]
            clock.append([float(error[b]) for b in kind.scored])
    return rows, clock


def uncropped_clock(trials: list, kind: Kind) -> list[list[float]]:
    """Leave-one-out errors of the training mean without cropping, where the clock reveals the labels."""
    labels = np.array([labels for _, labels in trials])
    means = (labels.sum(0) - labels) / (len(labels) - 1)
    return [[float(row[b]) for b in kind.scored] for row in means - labels]


def without_labels(trials: list, kind: Kind, channels: tuple[str, ...], seed: int) -> list:
    """Learned from the trials themselves."""
    rng = np.random.default_rng(seed)
    data = [cropped(trial, rng.uniform(0, MAX_CROP)) for trial, _ in trials]
    results = segment_sequence(data, SequenceTask(kind.sequence, channels))
    return [_scored(result, kind, labels) for result, (_, labels) in zip(results, trials, strict=True)]


def summary(rows: list[dict]) -> dict:
    """Per scored boundary: median and 95 % of |difference| [s], bias, share within 0.3 s, coverage."""
    difference = np.array([row["difference"] for row in rows])
    return {
        "trials": len(rows),
        "median_abs": np.median(np.abs(difference), 0).tolist(),
        "p95_abs": np.quantile(np.abs(difference), 0.95, axis=0).tolist(),
        "max_abs": np.abs(difference).max(0).tolist(),
        "median_signed": np.median(difference, 0).tolist(),
        "within_0.3": (np.abs(difference) <= 0.3).mean(0).tolist(),
        "coverage_90": np.mean([row["in_90"] for row in rows], 0).tolist(),
        "complete": float(np.mean([row["complete"] for row in rows])),
    }


def run(folder: Path, seeds: int) -> dict:
    """All results of the experiment."""
    document: dict = {"format": "experiments.hiro_snap/1", "seeds": seeds, "max_crop": MAX_CROP, "kinds": {}}
    for name in SHOWN:
        kind = KINDS[name]
        trials = read_kind(folder, name)
        entry: dict = {
            "training_mean_uncropped": np.median(np.abs(uncropped_clock(trials, kind)), 0).tolist()
        }
        for label, channels in (("wrench_and_pose", WRENCH_AND_POSE), ("wrench", WRENCH)):
            taught, clock, alone = [], [], []
            for seed in range(seeds):
                rows, mean = with_labels(trials, kind, channels, seed)
                taught, clock = taught + rows, clock + mean
                alone += without_labels(trials, kind, channels, seed)
            entry[label] = {"with_labels": summary(taught), "without_labels": summary(alone)}
            entry["training_mean"] = np.median(np.abs(clock), 0).tolist()
        document["kinds"][name] = entry
    return document


def table(found: dict) -> str:
    """docs/results.md: errors at both contact boundaries, by what was learned from."""
    rows = []
    for kind, label in SHOWN.items():
        entry = found["kinds"][kind]
        for key, words in CLOCKS.items():
            rows.append([label, words, *(f"{1e3 * value:.0f} ms" for value in entry[key])])
        for channels, heard in HEARD.items():
            for method, learned in METHODS.items():
                s = entry[channels][method]
                cells = [
                    f"{1e3 * s['median_abs'][b]:.0f} ms, {1e3 * s['p95_abs'][b]:.0f} ms, "
                    f"{100 * s['within_0.3'][b]:.0f} %"
                    for b in (0, 1)
                ]
                rows.append([label, f"{heard}; {learned}", *cells])
    head = ["trials", "learned from", "approach to rotation", "insertion to mating"]
    trials = ", ".join(
        f"{found['kinds'][kind]['wrench']['with_labels']['trials'] // found['seeds']} {label}"
        for kind, label in SHOWN.items()
    )
    note = (
        f"Snap assembly by a HIRO robot (200 Hz; {trials} trials, {found['seeds']} random crops of up to "
        f"{found['max_crop']:g} s each): median error against the controller's labels, 95th percentile, "
        "share within 0.3 s. Goals: a median of 60 ms with labels, all within 0.3 s without."
    )
    return f"{note}\n\n{markdown(head, rows)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=2, help="random crops and halvings")
    parser.add_argument("--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    document = run(arguments.folder, arguments.seeds)
    save(arguments.output, document)


if __name__ == "__main__":
    main()
