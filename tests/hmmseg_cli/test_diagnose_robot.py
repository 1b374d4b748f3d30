"""`hmmseg diagnose --simulator`: from logs to a document, and lines about options that do not go together."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from simgap_swing import log

from hmmseg_cli.main import main

SWING = Path(__file__).resolve().parents[1] / "simgap_swing.py"


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two logs of a pendulum with friction that its model lacks."""
    folder = tmp_path_factory.mktemp("logs")
    for seed in range(2):
        found = log(seed, seconds=4.0, viscous=0.004)
        rows = np.column_stack([found.t, found["torque"], found["angle"]])
        np.savetxt(folder / f"{seed}.csv", rows, delimiter=",", header="t,torque,angle", comments="")
    return [str(folder / f"{seed}.csv") for seed in range(2)]


@pytest.mark.slow
def test_a_cause_is_named_and_patched(logs, tmp_path):
    target = tmp_path / "out.json"
    patch = tmp_path / "patch"
    page = tmp_path / "page.html"
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
    assert "With it in the model the gap shrinks by over 99 % on held-out stretches" in said


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (["--mjcf", "robot.xml"], "--map: missing"),
        (["--map", "map.toml"], "goes with a MuJoCo model; expected --mjcf XML"),
        (["--candidate", "joint:a.damping"], "goes with a MuJoCo model"),
        (["--simulator", "x.py:Y", "--mjcf", "robot.xml"], "--mjcf: does not go with --simulator"),
        (["--simulator", f"{SWING}:Swing", "--rig", "rig.toml"], "--rig: does not go with a simulator"),
        (["--simulator", f"{SWING}:Swing", "--effect", "viscos"], r"is no candidate; expected .*viscous"),
        (["--simulator", f"{SWING}:Swung"], "did you mean Swing"),
        (["--mjcf", "robot.xml", "--map", "map.toml"], "no such file"),
    ],
)
def test_what_does_not_go_together_is_said(logs, capsys, options, line):
    assert main(["diagnose", *logs, *options]) == 2
    told = capsys.readouterr().err
    assert re.search(line, told) and "Traceback" not in told


@pytest.mark.slow
def test_what_changed_since_healthy_logs_is_named(logs, tmp_path):
    folder = tmp_path
    for seed in range(3):
        found = log(seed + 10, seconds=4.0)
        rows = np.column_stack([found.t, found["torque"], found["angle"]])
        np.savetxt(folder / f"old_{seed}.csv", rows, delimiter=",", header="t,torque,angle", comments="")
    old = [str(folder / f"old_{seed}.csv") for seed in range(3)]
    target, page = folder / "out.json", folder / "page.html"
    kept = folder / "history.jsonl"
    options = ["--simulator", f"{SWING}:Swing", "--json", str(target), "--report", str(page), "--quiet"]
    options += ["--history", str(kept)]
    patch = ["--patch", str(folder / "patch")]
    assert main(["diagnose", *logs, "--healthy", *old, *options, *patch]) == 0
    found = json.loads(target.read_text())
    assert found["verdict"] == "named" and found["causes"] == ["viscous"]
    told = found["effects"]["viscous"]["parameters"]["viscous"]
    assert told["interval_90"][0] < 0.004 < told["interval_90"][1] and told["old"] == 0.0
    assert abs(sum(found["probabilities"].values()) - 1) < 1e-9
    assert "iscous" in page.read_text()
    ranges = json.loads((folder / "patch" / "ranges.json").read_text())
    assert ranges["causes"]["viscous"]["parameters"]["viscous"]["range"] == told["interval_90"]
    (run,) = map(json.loads, kept.read_text().splitlines())
    assert run["parameters"]["viscous"]["interval_90"] == told["interval_90"]
    assert main(["diagnose", old[0], "--healthy", *old[1:], *options]) == 0
    assert json.loads(target.read_text())["verdict"] == "none"


def test_an_effect_cannot_be_forced_of_a_change(logs, capsys):
    options = ["--simulator", f"{SWING}:Swing", "--healthy", logs[1], "--effect", "viscous"]
    assert main(["diagnose", logs[0], *options]) == 2
    assert "--effect: does not go with --healthy and a model" in capsys.readouterr().err
