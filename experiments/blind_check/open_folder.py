"""Open cases of drawn worlds, in the layout of a folder of recordings: answers lie beside the trials.

What judges code on folders of recordings (`experiments.identified`, `experiments.gap_recordings`,
`experiments.calibration_boundaries --folders`) can so be run on as many labs of the second simulator as are
drawn. Nothing is sealed: whoever changes code by such a folder draws another one to judge the change.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

from experiments.blind_check.cases import Case, Recorded, draw_cases, record_case
from experiments.blind_check.generate import NOMINAL, write_folder
from experiments.blind_check.hand import load_rig


def write_open(
    out: Path,
    count: int,
    seed: int,
    shares: Mapping[str, int],
    fastest: float = float("inf"),
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """OUT/CASE (rig.toml, task.toml, trial_NN.csv, truth/trial_NN.json) and OUT/labels.json.

    `shares` of the tiers as in `experiments.blind_check.cases.TIERS`; cases already written are kept.
    """
    nominal = load_rig(NOMINAL / "rig.toml")
    cases = draw_cases(count, seed, nominal, shares=shares, fastest=fastest)
    for k, case in enumerate(cases):
        folder = out / case.name
        if not (folder / "truth").exists():
            trials = record_case(case, nominal)
            write_folder(folder, case, trials, nominal)
            _write_truth(folder, trials)
        if progress is not None:
            progress(k + 1, count)
    labels = json.dumps([_label(case) for case in cases], indent=1)
    (out / "labels.json").write_text(labels + "\n", encoding="utf-8")


def _write_truth(folder: Path, trials: list[Recorded]) -> None:
    (folder / "truth").mkdir()
    for k, trial in enumerate(trials):
        text = json.dumps({"boundaries": [round(b, 6) for b in trial.boundaries]})
        (folder / "truth" / f"trial_{k + 1:02d}.json").write_text(text + "\n", encoding="utf-8")


def _label(case: Case) -> dict:
    blocks = {
        n: {"weight": b.weight, "width": b.width, "height": b.height, "mu": b.friction}
        for n, b in case.blocks.items()
    }
    return {
        "case": case.name, "tier": case.tier, "effects": list(case.effects) or ["none"],
        "params": case.effects, "blocks": blocks, "brackets": case.world.brackets(),
        "world": asdict(case.world),
    }  # fmt: skip
