"""`hmmseg diagnose` and `hmmseg effects`, of hands and simulators: documents, refusals, patches, pages."""

import io
import json
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from types import SimpleNamespace as NS

import numpy as np
import pandas as pd
import pytest
from demo_recordings import FOLDER
from rich.console import Console
from simgap_swing import log

import hmmseg
from hmmseg.numbers import percent
from hmmseg_cli import diagnose as command
from hmmseg_cli.diagnose import tables
from hmmseg_cli.main import main
from simgap.world.properties import PAPER_BLOCKS

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
DATA = hmmseg.example_folder()
HEADLESS = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            "--virtual-time-budget=5000")  # fmt: skip
SWING = Path(__file__).resolve().parents[1] / "simgap_swing.py"


def test_effects_are_listed_with_priors_and_experiments_with_what_they_promise(tmp_path, capsys):
    assert main(["effects", "--json", str(tmp_path / "e.json")]) == 0
    document = json.loads((tmp_path / "e.json").read_text())
    assert document["format"] == "hmmseg.effects/1"
    bias = next(e for e in document["effects"] if e["name"] == "force_bias")
    assert [p["name"] for p in bias["parameters"]] == ["fx1", "fy1", "fx2", "fy2"]
    assert bias["parameters"][0]["unit"] == "N" and "force_bias" in capsys.readouterr().out
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


def test_contradicting_scales_and_trials_told_twice_are_refused_before_any_search(tmp_path, capsys):
    slow = pd.read_csv(FOLDER / "trial_01.csv").assign(t=lambda table: 1.25 * table.t)
    rig = tomllib.loads((FOLDER / "rig.toml").read_text())
    line = r"times as far as their velocities carry them.*; expected t = \{from = .t., unit = 0.8"
    with pytest.raises(hmmseg.InputError, match=line):
        hmmseg.diagnose(slow, FOLDER / "task.toml", {k: v for k, v in rig.items() if k != "rate"})
    hand = ["--task", str(FOLDER / "task.toml"), "--rig", str(FOLDER / "rig.toml")]
    trial = str(FOLDER / "trial_01.csv")
    assert main(["diagnose", trial, *hand, "--healthy", trial]) == 2
    assert "the same trial as" in capsys.readouterr().err


def named(gone: float | None) -> dict:
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
    page, rig = tmp_path / "gap.html", tmp_path / "rig.toml"
    text = (DATA / "rig.toml").read_text(encoding="utf-8")
    rig.write_text(text.replace("normal_stiffness = 4000.0", "normal_stiffness = inf"), encoding="utf-8")
    args = ["--task", str(DATA / "task.toml"), "--rig", str(rig), "--report", str(page), "--quiet"]
    assert main(["diagnose", *trials, *args]) == 0
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


def swung(folder, seeds, **changed) -> list[str]:
    """Files of logs of a pendulum with some parameters changed."""
    for seed in seeds:
        found = log(seed, seconds=4.0, **changed)
        rows = np.column_stack([found.t, found["torque"], found["angle"]])
        np.savetxt(folder / f"{seed}.csv", rows, delimiter=",", header="t,torque,angle", comments="")
    return [str(folder / f"{seed}.csv") for seed in seeds]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    return swung(tmp_path_factory.mktemp("logs"), range(2), viscous=0.004)  # which its model lacks


@pytest.mark.slow
def test_a_cause_is_named_and_patched(logs, tmp_path):
    target, patch, page = (tmp_path / name for name in ("out.json", "patch", "page.html"))
    options = ["--json", str(target), "--patch", str(patch), "--report", str(page), "--quiet"]
    assert main(["diagnose", *logs, "--simulator", f"{SWING}:Swing", *options]) == 0
    found = json.loads(target.read_text())
    assert found["verdict"] == "named" and found["causes"] == ["viscous"]
    told = found["effects"]["viscous"]["parameters"]["viscous"]
    assert told["interval_90"][0] < 0.004 < told["interval_90"][1]
    assert abs(sum(found["probabilities"].values()) - 1) < 1e-9
    assert found["shrinkage"]["fraction"] > 0.9 and found["remainder"]["share"] < 0.1
    moving = found["shrinkage"]["by_phase"]["moving"]
    assert moving["fraction"] > 0.9 and moving["rms"]["angle"]["after"] < moving["rms"]["angle"]["before"]
    ranges = json.loads((patch / "ranges.json").read_text())
    assert ranges["causes"]["viscous"]["parameters"]["viscous"]["range"] == told["interval_90"]
    said = page.read_text()
    assert "Viscous" in said
    shrinks = percent(found["shrinkage"]["fraction"])
    assert f"With it in the model the gap shrinks by {shrinks} on held-out stretches" in said


@pytest.mark.parametrize(("options", "line"), [
    (["--mjcf", "robot.xml"], "--map: missing"),
    (["--map", "map.toml"], "goes with a MuJoCo model; expected --mjcf XML"),
    (["--candidate", "joint:a.damping"], "goes with a MuJoCo model"),
    (["--simulator", "x.py:Y", "--mjcf", "robot.xml"], "--mjcf: does not go with --simulator"),
    (["--simulator", f"{SWING}:Swing", "--rig", "rig.toml"], "--rig: does not go with a simulator"),
    (["--simulator", f"{SWING}:Swing", "--effect", "viscos"], r"is no candidate; expected .*viscous"),
    (["--simulator", f"{SWING}:Swung"], "did you mean Swing"),
    (["--mjcf", "robot.xml", "--map", "map.toml"], "no such file")])  # fmt: skip
def test_what_does_not_go_together_is_said(logs, capsys, options, line):
    assert main(["diagnose", *logs, *options]) == 2
    told = capsys.readouterr().err
    assert re.search(line, told) and "Traceback" not in told


@pytest.mark.slow
def test_what_changed_since_healthy_logs_is_named(logs, tmp_path):
    old, patch = swung(tmp_path, range(10, 13)), ["--patch", str(tmp_path / "patch")]
    target, page, kept = (tmp_path / name for name in ("out.json", "page.html", "history.jsonl"))
    options = ["--simulator", f"{SWING}:Swing", "--json", str(target), "--report", str(page), "--quiet",
               "--history", str(kept)]  # fmt: skip
    assert main(["diagnose", *logs, "--healthy", *old, *options, *patch]) == 0
    found = json.loads(target.read_text())
    assert found["verdict"] == "named" and found["causes"] == ["viscous"]
    told = found["effects"]["viscous"]["parameters"]["viscous"]
    assert told["interval_90"][0] < 0.004 < told["interval_90"][1] and told["old"] == 0.0
    assert abs(sum(found["probabilities"].values()) - 1) < 1e-9 and "iscous" in page.read_text()
    ranges = json.loads((tmp_path / "patch" / "ranges.json").read_text())
    assert ranges["causes"]["viscous"]["parameters"]["viscous"]["range"] == told["interval_90"]
    (run,) = map(json.loads, kept.read_text().splitlines())
    assert run["parameters"]["viscous"]["interval_90"] == told["interval_90"]
    assert main(["diagnose", old[0], "--healthy", *old[1:], *options]) == 0
    assert json.loads(target.read_text())["verdict"] == "none"


def test_an_effect_cannot_be_forced_of_a_change(logs, capsys):
    options = ["--simulator", f"{SWING}:Swing", "--healthy", logs[1], "--effect", "viscous"]
    assert main(["diagnose", logs[0], *options]) == 2
    assert "--effect: does not go with --healthy and a model" in capsys.readouterr().err


@pytest.mark.slow
def test_the_patch_has_what_was_calibrated_and_what_changed(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(
        """<mujoco><option timestep="0.002"/><worldbody><body>
        <joint name="hinge" axis="0 1 0" damping="0.02"/>
        <geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.01" mass="0.3"/></body></worldbody>
        <actuator><position name="servo" joint="hinge" kp="10" kv="0.3"/></actuator></mujoco>"""
    )
    (tmp_path / "map.toml").write_text(
        '[columns.u]\nactuator = "servo"\n[columns.q]\njoint = "hinge"\nnoise = 2e-4\n'
        '[columns.f]\nactuator = "servo"\nkind = "force"\nnoise = 0.01\n'
    )
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    model.dof_frictionloss[0], t, files = 0.05, np.arange(0, 3, 0.01), []
    for name, damping in (("old", 0.02), ("new", 0.06)):
        model.dof_damping[0] = damping
        for seed in range(4):
            rng, data, rows = np.random.default_rng(seed), mujoco.MjData(model), []
            waves = rng.uniform(2, 8, 3), rng.uniform(0, 6, 3)
            u = 0.3 * np.sin(t[:, None] * waves[0] + waves[1]).sum(1)
            data.qpos[0] = u[0]
            for k in range(t.size):
                data.ctrl[0] = u[k]
                mujoco.mj_forward(model, data)
                q = data.qpos[0] + 2e-4 * rng.standard_normal()
                rows.append([t[k], u[k], q, data.actuator_force[0] + 0.01 * rng.standard_normal()])
                mujoco.mj_step(model, data, 5)
            files.append(str(tmp_path / f"{name}_{seed}.csv"))
            np.savetxt(files[-1], rows, delimiter=",", header="t,u,q,f", comments="")
    robot = ["--mjcf", str(tmp_path / "arm.xml"), "--map", str(tmp_path / "map.toml"), "--quiet"]
    told = ["--json", str(tmp_path / "out.json"), "--patch", str(tmp_path / "patch")]
    assert main(["diagnose", *files[4:], "--healthy", *files[:4], *robot, *told]) == 0
    assert json.loads((tmp_path / "out.json").read_text())["causes"] == ["joint:hinge.damping"]
    patched = mujoco.MjModel.from_xml_path(str(tmp_path / "patch" / "arm.xml"))
    assert patched.dof_frictionloss[0] == pytest.approx(0.05, rel=0.05)
    assert patched.dof_damping[0] == pytest.approx(0.06, rel=0.1)
    ranges = json.loads((tmp_path / "patch" / "ranges.json").read_text())
    assert "joint:hinge.frictionloss" in ranges["fitted"] and "joint:hinge.damping" not in ranges["fitted"]
