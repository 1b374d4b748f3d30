"""`hmmseg diagnose` and `hmmseg effects`: documents, refusals, patches and the page in a real browser."""

import io
import json
import shutil
import subprocess
import tomllib
from types import SimpleNamespace as NS

import pandas as pd
import pytest
from demo_recordings import FOLDER
from rich.console import Console

import hmmseg
from hmmseg_cli import diagnose as command
from hmmseg_cli.diagnose import tables
from hmmseg_cli.main import main
from simgap.world.properties import PAPER_BLOCKS

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
DATA = hmmseg.example_folder()
HEADLESS = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            "--virtual-time-budget=5000")  # fmt: skip


def test_effects_are_listed_with_priors(tmp_path, capsys):
    assert main(["effects", "--json", str(tmp_path / "e.json")]) == 0
    document = json.loads((tmp_path / "e.json").read_text())
    assert document["format"] == "hmmseg.effects/1"
    bias = next(e for e in document["effects"] if e["name"] == "force_bias")
    assert [p["name"] for p in bias["parameters"]] == ["fx1", "fy1", "fx2", "fy2"]
    assert bias["parameters"][0]["unit"] == "N" and "force_bias" in capsys.readouterr().out


def test_scales_that_contradict_each_other_are_told_before_any_search(tmp_path):
    slow = pd.read_csv(FOLDER / "trial_01.csv").assign(t=lambda table: 1.25 * table.t)
    rig = tomllib.loads((FOLDER / "rig.toml").read_text())
    line = r"times as far as their velocities carry them.*; expected t = \{from = .t., unit = 0.8"
    with pytest.raises(hmmseg.InputError, match=line):
        hmmseg.diagnose(slow, FOLDER / "task.toml", {k: v for k, v in rig.items() if k != "rate"})


def test_no_trial_is_its_own_healthy_one(capsys):
    hand = ["--task", str(FOLDER / "task.toml"), "--rig", str(FOLDER / "rig.toml")]
    trial = str(FOLDER / "trial_01.csv")
    assert main(["diagnose", trial, *hand, "--healthy", trial]) == 2
    assert "the same trial as" in capsys.readouterr().err


def test_the_next_experiment_says_what_it_promises():
    asked = {"do": "work twice as fast", "separates": ["force_lag", "force_lowpass"],
             "expected_gain_nats": 41.3}  # fmt: skip
    body = {"probabilities": {"force_lag": 1.0}, "causes": [], "where": [], "next_experiment": asked}
    sink = io.StringIO()
    console = Console(width=120, file=sink)
    for table in tables(body):
        console.print(table)
    said = sink.getvalue()
    assert "work twice as fast" in said
    assert "expected to separate force_lag, force_lowpass, by 41 nats at least" in said
    assert len(tables(body | {"next_experiment": None})) == len(tables(body)) - 1


def named(gone: float | None) -> dict:
    """The document of a diagnosis that found a gain, `gone` of the gap with it on held-out trials."""
    parameters = {"gain": {"mean": 0.088, "sd": 0.003, "interval_90": [0.083, 0.093], "unit": "1"}}
    shift = {f"{name}.{key}": {"before": getattr(block, key), "after": getattr(block, key), "unit": unit}
             for name, block in dict(PAPER_BLOCKS).items()
             for key, unit in (("weight", "N"), ("width", "m"), ("height", "m"))}  # fmt: skip
    return {"causes": ["force_gain"],
            "effects": {"force_gain": {"parameters": parameters, "property_shift": shift}},
            "shrinkage": {"fraction": gone}}  # fmt: skip


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


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
def test_the_page_opens_in_a_browser(tmp_path):
    trials = [str(DATA / f"trial_0{k}.csv") for k in (1, 2)]
    page = tmp_path / "gap.html"
    rig = tmp_path / "rig.toml"
    text = (DATA / "rig.toml").read_text(encoding="utf-8")
    rig.write_text(text.replace("normal_stiffness = 4000.0", "normal_stiffness = inf"), encoding="utf-8")
    args = ["--task", str(DATA / "task.toml"), "--rig", str(rig), "--report", str(page), "--quiet"]
    assert main(["diagnose", *trials, *args]) == 0 and BROWSER is not None
    command = [BROWSER, *HEADLESS, f"--user-data-dir={tmp_path / 'profile'}"]
    shown = subprocess.run([*command, "--dump-dom", page.as_uri()], capture_output=True, text=True,
                           timeout=60, check=True)  # fmt: skip
    for id in ("verdict", "next", "heat", "where", "suspects", "parameters", "properties"):
        assert f'id="{id}"' in shown.stdout
    assert "Fingertips that yield" in shown.stdout.split('id="verdict"')[1].split("</p>")[0]
    picture = tmp_path / "page.png"
    subprocess.run([*command, f"--screenshot={picture}", "--window-size=1000,2400", page.as_uri()],
                   capture_output=True, timeout=60, check=True)  # fmt: skip
    assert picture.stat().st_size > 50_000  # figures and all; a blank page has a tenth of it
