"""What counts as a set that its next experiment told apart: hand-made sets, results and second diagnoses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from experiments.blind_check.follow import follow
from experiments.blind_check.sealing import seal

EXPERIMENT = {
    "do": "work twice as fast",
    "separates": ["force_gain", "force_lag"],
    "expected_gain_nats": 20.0,
}
# Case: its effects, the partners of force_gain, the experiment, and what is said of old and new recordings.
CASES = {
    "told": (["force_gain"], ["force_lag"], EXPERIMENT, ("named", ["force_gain"], [])),
    "still alike": (["force_gain"], ["force_lag"], EXPERIMENT, ("set", ["force_gain"], ["force_lag"])),
    "wrong": (["force_gain"], ["force_lag"], EXPERIMENT, ("named", ["force_lag"], [])),
    "no promise of it": (["force_gain"], ["backlash"], EXPERIMENT, ("set", ["force_gain"], ["backlash"])),
    "refused": (["force_gain"], ["force_lag"], EXPERIMENT, None),
    "no experiment": (["force_gain"], ["force_lag"], None, None),
    "healthy": ([], ["force_lag"], EXPERIMENT, None),
    "not in the set": (["table_tilt"], ["force_lag"], EXPERIMENT, None),
}


def written(file: Path, table: dict) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(table), encoding="utf-8")


def test_a_set_is_separated_where_the_truth_alone_is_left_of_what_was_promised(tmp_path: Path):
    labels = {"cases": [{"case": name, "effects": {key: {} for key in c[0]}} for name, c in CASES.items()]}
    seal(tmp_path / "set", labels, "salt")
    for name, (_, partners, experiment, after) in CASES.items():
        found = {"verdict": "set", "causes": ["force_gain"], "indistinguishable": partners}
        written(tmp_path / "found" / f"{name}.json", found | {"next_experiment": experiment})
        second = {"error": "does not fit its task"}
        if after is not None:
            second = dict(zip(("verdict", "causes", "indistinguishable"), after, strict=True))
        written(tmp_path / "found" / "follow" / name / "diagnosis.json", second)
    rows = {row["case"]: row["separated"] for row in follow(tmp_path / "set", tmp_path / "found")}
    assert rows == {
        "told": True, "still alike": False, "wrong": False, "no promise of it": True, "refused": False,
        "no experiment": None,
    }  # fmt: skip
