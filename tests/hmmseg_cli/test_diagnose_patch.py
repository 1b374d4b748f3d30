"""`hmmseg diagnose --patch` writes what held-out trials bear out, and says where."""

import json
import tomllib
from types import SimpleNamespace as NS

import pytest
from demo_recordings import FOLDER

from hmmseg_cli import diagnose as command
from hmmseg_cli.main import main
from simgap.world.properties import PAPER_BLOCKS


def named(gone: float | None) -> dict:
    """The document of a diagnosis that found a gain, `gone` of the gap with it on held-out trials."""
    parameters = {"gain": {"mean": 0.088, "sd": 0.003, "interval_90": [0.083, 0.093], "unit": "1"}}
    shift = {
        f"{name}.{key}": {"before": getattr(block, key), "after": getattr(block, key), "unit": unit}
        for name, block in dict(PAPER_BLOCKS).items()
        for key, unit in (("weight", "N"), ("width", "m"), ("height", "m"))
    }
    return {
        "causes": ["force_gain"],
        "effects": {"force_gain": {"parameters": parameters, "property_shift": shift}},
        "shrinkage": {"fraction": gone},
    }


@pytest.mark.parametrize("gone", [0.79, -0.05, None])
def test_what_shrinks_the_gap_on_held_out_trials_is_written(gone, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "run", lambda *given: NS(body=named(gone)))
    folder, document = tmp_path / "corrected", tmp_path / "gap.json"
    args = ["diagnose", str(FOLDER / "trial_01.csv"), "--patch", str(folder), "--json", str(document)]
    assert main(args) == 0
    warnings, told = json.loads(document.read_text())["warnings"], capsys.readouterr()
    if gone is None or gone > 0:
        assert {file.name for file in folder.iterdir()} == {"rig.toml", "ranges.json", "actual.toml"}
        effects = tomllib.loads((folder / "rig.toml").read_text())["effects"]
        assert effects["force_gain"]["gain"] == pytest.approx(0.088) and not warnings
        assert "put into" in told.out.replace("\n", " ") and ("79 %" in told.out) == (gone is not None)
    else:
        assert not folder.exists() or not any(folder.iterdir())
        (warning,) = warnings
        assert "takes nothing off held-out trials" in warning and "nothing is written" in told.err
