"""`hmmseg diagnose --patch` writes a corrected model that predicts forces better, and refuses a worse one."""

from __future__ import annotations

import json
from types import SimpleNamespace as NS

import pandas as pd
import pytest
from demo_recordings import FOLDER

from hmmseg.io.trial import read_trial
from hmmseg_cli import diagnose as command
from hmmseg_cli.main import main
from simgap.world.properties import PAPER_BLOCKS

BIAS = 0.3  # N; put on one finger's fy of what was recorded


def named(bias: float) -> dict:
    """The document of a diagnosis that found this bias, and the blocks as they are."""
    parameters = {
        name: {"mean": value, "sd": 0.01, "interval_90": [value - 0.02, value + 0.02], "unit": "N"}
        for name, value in (("fx1", 0.0), ("fy1", bias), ("fx2", 0.0), ("fy2", 0.0))
    }
    shift = {
        f"{name}.{key}": {"before": getattr(block, key), "after": getattr(block, key), "unit": unit}
        for name, block in dict(PAPER_BLOCKS).items()
        for key, unit in (("weight", "N"), ("width", "m"), ("height", "m"))
    }
    return {
        "causes": ["force_bias"],
        "effects": {"force_bias": {"parameters": parameters, "property_shift": shift}},
    }


@pytest.mark.parametrize("found", [BIAS, -BIAS])
def test_only_a_model_that_predicts_better_is_written(found, tmp_path, monkeypatch, capsys):
    table = pd.read_csv(FOLDER / "trial_01.csv")
    table["fy1"] += BIAS
    table.to_csv(tmp_path / "trial.csv", index=False)

    def run(out, paths, task, rig, *more):
        trials = [read_trial(path, rig) for path in paths]
        return NS(body=named(found), search=NS(trials=trials), problem=NS(frame=NS(task=task, rig=rig)))

    monkeypatch.setattr(command, "run", run)
    folder, document = tmp_path / "corrected", tmp_path / "gap.json"
    args = ["diagnose", str(tmp_path / "trial.csv"), "--task", str(FOLDER / "task.toml"),
            "--rig", str(FOLDER / "rig.toml"), "--patch", str(folder), "--json", str(document)]  # fmt: skip
    assert main(args) == 0
    warnings, told = json.loads(document.read_text())["warnings"], capsys.readouterr()
    if found == BIAS:
        assert {file.name for file in folder.iterdir()} == {"rig.toml", "ranges.json", "actual.toml"}
        assert "the corrected model is in" in told.out and not warnings
    else:
        assert not folder.exists() or not any(folder.iterdir())
        (warning,) = warnings
        assert "the corrected model is no better" in warning and "nothing is written" in told.err
