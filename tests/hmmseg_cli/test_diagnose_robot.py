"""`hmmseg diagnose --simulator`: from logs to a document, and lines about options that do not go together."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from simgap_swing import log

from hmmseg.numbers import percent
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
    (["--mjcf", "robot.xml", "--map", "map.toml"], "no such file"),
])  # fmt: skip
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
    assert abs(sum(found["probabilities"].values()) - 1) < 1e-9 and "iscous" in page.read_text()
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


@pytest.mark.slow
def test_the_patch_has_what_was_calibrated_and_what_changed(tmp_path):
    """A motor with friction that its model lacks, before and after its damping grew."""
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
