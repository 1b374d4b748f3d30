"""The next experiment carried out: where a set was named, record what the diagnosis asks for and diagnose it.

Done after the seal is opened, since the same blocks and effects have to be recorded once more.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from experiments.blind_check.cases import TRIALS, Case, record_case
from experiments.blind_check.diagnose import diagnose_folder
from experiments.blind_check.generate import NOMINAL, write_folder
from experiments.blind_check.hand import load_rig
from experiments.blind_check.operator import Style
from experiments.blind_check.scene import Block
from experiments.blind_check.sealing import unseal
from experiments.blind_check.worlds import world_of

KNOWN = {f.name for f in fields(Style)}


def follow(folder: Path, results: Path, progress=None, first: int | None = None) -> list[dict[str, Any]]:
    """One entry for every set (of the `first` cases) that holds the true cause; written case by case.

    `separated`: old and new recordings together are given the true cause, and nothing is left beside it of
    what the experiment was to tell from it. None where the diagnosis knew of no experiment.
    """
    out = []
    for entry in unseal(folder)["cases"][:first]:
        found = json.loads((results / f"{entry['case']}.json").read_text(encoding="utf-8"))
        if found.get("verdict") != "set" or not entry["effects"]:
            continue
        if not set(entry["effects"]) <= {*found["causes"], *found["indistinguishable"]}:
            continue
        asked = found["next_experiment"]
        if asked is None:
            out.append(
                {"case": entry["case"], "true": sorted(entry["effects"]), "do": None, "separated": None}
            )
            continue
        place = results / "follow" / entry["case"]
        file = place / "diagnosis.json"
        if not file.exists():
            _record(entry, asked, place)
            for old in sorted((folder / "cases" / entry["case"]).glob("trial_*.csv")):
                shutil.copy(old, place / old.name.replace("trial_", "trial_1"))
            file.write_text(json.dumps(diagnose_folder(place)) + "\n", encoding="utf-8")
            if progress is not None:
                progress(entry["case"])
        after = json.loads(file.read_text(encoding="utf-8"))
        right = sorted(after.get("causes", [])) == sorted(entry["effects"])
        beside = set(after.get("indistinguishable", [])) & set(asked["separates"])
        out.append({
            "case": entry["case"], "true": sorted(entry["effects"]), "do": asked["do"],
            "expected_gain_nats": asked["expected_gain_nats"],
            "said": after.get("causes", []), "verdict": after.get("verdict", "error"),
            "separated": right and not beside,
        })  # fmt: skip
    return out


def _record(entry: dict[str, Any], asked: dict[str, Any], place: Path) -> None:
    """Fresh trials of a sealed case in the style that was asked for."""
    blocks = {n: Block(**b) for n, b in entry["blocks"].items()}
    case = Case(
        entry["case"], entry["seed"], entry["tier"], world_of(entry), blocks, entry["effects"],
        entry["sizes"], entry["measured"], tuple(entry["exclude"]),
    )  # fmt: skip
    unknown = set(asked["operator"]) - KNOWN
    if unknown:
        raise ValueError(f"{entry['case']}: the simulated operator has no setting {sorted(unknown)}")
    style = {k: (float(v[0]), float(v[1])) for k, v in asked["operator"].items()}
    if not style:  # nothing to be done otherwise: the blocks are to be measured
        case = replace(case, measured=True)
    nominal = load_rig(NOMINAL / "rig.toml")
    write_folder(place, case, record_case(case, nominal, style, first=TRIALS), nominal)
