"""Grippers with a wrist sensor: an arm of another simulator, and many setups of our own.

    python -m experiments.wrist [FOLDER with wrist_restack_1 and wrist_untared]

Each case: four trials of the arm, or two of a setup of `experiments.wrist_scene`, segmented and identified
together. Boundary errors with their 90 % intervals, properties with their 95 % ones.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estimation.identification import identify_aligned
from experiments.recordings import read_boundaries
from experiments.saving import save
from experiments.scoring import (
    boundaries_covered,
    boundary_residuals,
    property_scores,
    summarise_boundaries,
    summarise_properties,
)
from experiments.table_text import RESULTS, markdown, milliseconds, percent
from experiments.wrist_scene import BLOCKS, TASK, Setup, performances, wrist_recording, wrist_rig
from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.io.formats import read_table
from hmmseg.io.rig import Rig, parse_rig, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.segmentation.align import align

ARM = Path("../shared/panda")
ARM_RIG = parse_rig({
    "gravity": 9.81,
    "gripper": {"position": {"y": "ee_y", "z": "ee_z"}, "opening": "width",
                "wrench": ["Fx", "Fy", "Fz"]},
    "columns": {"width": {"offset": -1.02e-3}},  # between the pads, as its own two-finger files have it
    "fingertip": {"normal_stiffness": 3735.0, "shear_stiffness": 2500.0},
})  # fmt: skip
# The wrench of the arm with the offset of a sensor that was never tared, N.
FRESH = 1000  # first seed: none that anything was made with
UNTARED = {"Fx": 3.0, "Fy": -2.0, "Fz": 7.0}
SETUPS: dict[str, tuple[Setup, dict]] = {
    "as it is": (Setup(), {}),
    "reaction, untared": (Setup(reaction=True, offset=(3.0, -2.0, 8.0)), {}),
    "all said": (Setup(reaction=True), {"reaction": True, "sensor_axes": ["y", "x", "-z"], "tool_mass": 0.7}),
    "turning, untared": (Setup(heading=0.9, tilt=0.1, offset=(1.0, 2.0, 3.0), reaction=True), {}),
    "turning more": (Setup(heading=0.4, tilt=0.25), {}),
    "world's axes, drifting": (Setup(frame="world", drift=0.02), {}),
    "poor sensors": (Setup(noise=0.05, position_noise=2e-4), {}),
    "a tool of 1.5 kg": (Setup(mass=1.5, noise=0.01), {}),
    "light tool": (Setup(mass=0.25), {}),
    "20 Hz": (Setup(rate=20.0), {}),
    "20 Hz, noisy": (Setup(rate=20.0, noise=0.03, position_noise=1e-4), {}),
    "100 Hz": (Setup(rate=100.0), {}),
    "200 Hz": (Setup(rate=200.0, noise=0.02), {}),
    "500 Hz": (Setup(rate=500.0, noise=0.03), {}),
}


def score(recordings: Sequence, rig: Rig, task: BlockTask, truths: Sequence, blocks: dict) -> dict:
    """Score a case: recordings against known boundaries [s] and blocks."""
    try:
        aligned = align([read_trial(each, rig) for each in recordings], task, rig)
        found = identify_aligned(aligned)
    except InputError as error:
        return {"refused": str(error)}
    pairs = list(zip(aligned.segmentations, truths, strict=True))
    residuals = np.concatenate([boundary_residuals(s, truth) for s, truth in pairs])
    covered = np.concatenate([boundaries_covered(s, truth) for s, truth in pairs])
    scores = property_scores(found.to_json()["properties"], blocks)
    complete = sum(s.complete for s in aligned.segmentations)
    missed = np.isnan(residuals)
    return {"trials": len(recordings), "complete": complete, "missing": int(missed.sum()),
            "residuals": [None if m else float(r) for r, m in zip(residuals, missed, strict=True)],
            "covered": [None if m else bool(c) for c, m in zip(covered, missed, strict=True)],
            "scores": scores, "warnings": list(found.warnings)}  # fmt: skip


def arm(folder: Path) -> dict[str, dict]:
    """The arm's four trials: from the wrist, tared or not, and as two fingers synthesised from it."""
    cases = {}
    source = folder / "wrist_restack_1"
    files = sorted(source.glob("wrist_*.csv"))
    cases["wrist"] = _arm_case(files, ARM_RIG, source)
    cases["wrist, untared"] = _arm_case([_offset(file) for file in files], ARM_RIG, source)
    for name in ("wrist_restack_1", "wrist_untared"):
        source = folder / name
        label = "made-up fingers" + ", untared" * (name == "wrist_untared")
        cases[label] = _arm_case(sorted(source.glob("trial_*.csv")), read_rig(source / "rig.toml"), source)
    return cases


def _arm_case(recordings: Sequence, rig: Rig, source: Path) -> dict:
    task = read_task(source / "task.toml")
    assert isinstance(task, BlockTask)
    blocks = json.loads((source / "truth.json").read_text())
    known = {name: {k: (block[k], 0.0) for k in ("weight", "width", "height")}
             for name, block in blocks.items()}  # fmt: skip
    truths = [read_boundaries(path) for path in sorted(source.glob("truth/trial_*.json"))]
    return score(recordings, rig, task, truths, known)


def _offset(file: Path) -> dict[str, np.ndarray]:
    """Columns of a recording with UNTARED added to its wrench."""
    columns = read_table(file, None).columns
    return {name: values + UNTARED.get(name, 0.0) for name, values in columns.items()}


def synthetic(name: str, count: int, seed: int = 0) -> dict:
    """Score `count` simulated trials of a setup."""
    setup, said = SETUPS[name]
    performed = performances(count, seed=seed)
    recordings = [wrist_recording(s, setup, seed + i) for i, s in enumerate(performed)]
    known = {name: {k: (getattr(block, k), 0.0) for k in ("weight", "width", "height")}
             for name, block in BLOCKS.items()}  # fmt: skip
    return score(recordings, wrist_rig(setup, **said), TASK, [s.boundaries for s in performed], known)


def summary(cases: Sequence[dict]) -> dict:
    """All cases of a group together."""
    there = [case for case in cases if "refused" not in case]
    residuals = [np.nan if r is None else r for case in there for r in case["residuals"]]
    covered = [np.nan if c is None else float(c) for case in there for c in case["covered"]]
    return {
        "cases": len(cases), "refused": len(cases) - len(there),
        "trials": sum(case["trials"] for case in there), "complete": sum(case["complete"] for case in there),
        "boundaries": summarise_boundaries(np.array(residuals), np.array(covered)),
        "boundaries_counted": int(np.isfinite(residuals).sum()),
        "latest": float(np.nanmax(np.abs(residuals))) if there else None,
        "properties": summarise_properties([s for case in there for s in case["scores"]]),
    }  # fmt: skip


WORST = ("wrist", "made-up fingers", "poor sensors", "20 Hz, noisy", "500 Hz")  # look: rows of a page


def wrist(found: dict, every: bool = False) -> str:
    """docs/wrist.md: all cases of a kind together, and the worst ones; with `every`, each case."""
    head = ["", "trials complete", "boundaries, median", "largest", "90 % hold", "weight, rms", "width, rms",
            "height, rms", "95 % hold"]  # fmt: skip
    rows = []
    for title, group in (("arm", found["arm"]), ("own simulator", found["synthetic"])):
        if group:
            rows.append([f"{title}: all", *_cells(summary([c for cases in group.values() for c in cases]))])
        for name, cases in group.items():
            if every or name in WORST:
                rows.append([f"{title}: {name}", *_cells(summary(cases))])
    return markdown(head, rows)


def _cells(s: dict) -> list[str]:
    b, p = s["boundaries"], s["properties"]
    if s["refused"] == s["cases"] or b["median"] is None:
        return [f"0 of {s['cases']}: refused", *[""] * 7]
    rms = [percent(p[k]["rms"], 2) if "rms" in p[k] else "none" for k in ("weight", "width", "height")]
    counted = sum(p[k]["count"] for k in p)
    held = sum(p[k]["count"] * p[k].get("coverage_95", 0.0) for k in p)
    return [f"{s['complete']} of {s['trials']}", milliseconds(b["median"]), milliseconds(s["latest"]),
            f"{100 * b['coverage_90']:.0f} % of {s['boundaries_counted']}", *rms,
            f"{held:.0f} of {counted}"]  # fmt: skip


def main() -> None:
    """Make `results/wrist.json`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", default=ARM)
    parser.add_argument("--seeds", type=int, default=3, help="performances of each setup")
    parser.add_argument("--only", help="setups whose name holds this, printed and not saved")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    document: dict = {"arm": {}, "synthetic": {}, "seeds": given.seeds}
    if given.folder.is_dir() and given.only is None:
        document["arm"] = {name: [case] for name, case in arm(given.folder).items()}
        for name, cases in document["arm"].items():
            print(
                name, *_cells(summary(cases)), *cases[0].get("warnings", [cases[0].get("refused")]), sep=" | "
            )
    for name in SETUPS:
        if given.only is None or given.only in name:
            cases = [synthetic(name, 2, FRESH + 10 * seed) for seed in range(given.seeds)]
            document["synthetic"][name] = cases
            print(name, *_cells(summary(cases)), sep=" | ", flush=True)
    every = [case for cases in document["synthetic"].values() for case in cases]
    print("all", *_cells(summary(every)), sep=" | ")
    if given.only is None:
        save(RESULTS / "wrist.json", document)


if __name__ == "__main__":
    main()
