"""hmmseg simulate: trials in the input format, a replay, an animation, and what it refuses."""

import json

import pytest
from PIL import Image
from simgap_scenes import HAND, STACK

from hmmseg.hand.read import read_trial
from hmmseg.io.rig import read_rig
from hmmseg.io.task import read_task
from hmmseg_cli.main import main
from simgap.world import animation
from simgap.world.properties import PAPER_BLOCKS
from simgap.world.simulate import scene_files

TASK = '[objects.block1]\non = "ground"\n[[moves]]\nobject = "block1"\nto = "ground"\n'
RIG = scene_files(STACK, HAND, PAPER_BLOCKS)["rig.toml"]


@pytest.fixture
def inputs(tmp_path) -> list[str]:
    (tmp_path / "task.toml").write_text(TASK)
    (tmp_path / "rig.toml").write_text(RIG)
    return ["--task", str(tmp_path / "task.toml"), "--rig", str(tmp_path / "rig.toml"), "--quiet"]


def test_trials_are_written_as_a_folder_of_recordings(tmp_path, inputs):
    out, report = tmp_path / "out", tmp_path / "out.json"
    args = ["simulate", *inputs, "--trials", "2", "--output", str(out), "--json", str(report)]
    assert main([*args, "--figures", str(tmp_path / "figures")]) == 0
    rig = read_rig(out / "rig.toml")
    assert rig == read_rig(tmp_path / "rig.toml")
    assert read_task(out / "task.toml") == read_task(tmp_path / "task.toml")
    document = json.loads(report.read_text())
    assert document["format"] == "hmmseg.simulate/1"
    assert document["properties"]["block1"]["weight"] == 0.343  # the paper's
    for k, row in enumerate(document["trials"], 1):
        trial = read_trial(out / f"trial_{k:02d}.csv", rig)
        truth = json.loads((out / f"truth/trial_{k:02d}.json").read_text())
        assert truth["seed"] == row["seed"]
        assert truth["boundaries"] == pytest.approx(row["boundaries"], abs=1e-6)
        assert len(trial.t) >= 100  # five seconds a move, or what the operator needs
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "trial_01_signals.png", "trial_02_signals.png"}  # fmt: skip
    assert all((tmp_path / name).exists() for name in document["files"])
    again = tmp_path / "again"
    assert main([*args[:-4], "--output", str(again), "--json", str(report)]) == 0
    assert (again / "trial_02.csv").read_bytes() == (out / "trial_02.csv").read_bytes()


@pytest.mark.parametrize("more", [
    '[columns]\nt = {from = "stamp", unit = "ms"}\nx1 = {from = "left [mm]", unit = "mm"}\n',
    '[gripper]\nposition = ["x", "y", "z"]\nopening = "w"\nwrench = ["fx", "fy", "fz"]\n'])  # fmt: skip
def test_the_rig_that_is_written_reads_the_trials_that_are(tmp_path, inputs, more):
    (tmp_path / "rig.toml").write_text("rate = 50.0\n" + more)
    out = tmp_path / "out"
    assert main(["simulate", *inputs, "--output", str(out)]) == 0
    trial = ["--task", str(out / "task.toml"), "--rig", str(out / "rig.toml"), "--quiet"]
    assert main(["segment", str(out / "trial_01.csv"), *trial]) == 0


def test_a_replay_predicts_the_recording_s_forces(tmp_path, inputs):
    made, out = tmp_path / "made", tmp_path / "replayed"
    assert main(["simulate", *inputs, "--output", str(made)]) == 0
    report = tmp_path / "replay.json"
    args = ["simulate", *inputs, "--properties", str(made / "actual.toml")]
    assert main([*args, "--replay", str(made / "trial_01.csv"), "--output", str(out), "--json", str(report),
                 "--figures", str(tmp_path / "figures")]) == 0  # fmt: skip
    rest = json.loads(report.read_text())["replay"]["net_force_residual_over_noise"]
    assert rest["free-motion"] < 1.5 and rest["hold-above-ground"] < 1.5
    rig = read_rig(out / "rig.toml")
    recorded, predicted = (read_trial(folder / "trial_01.csv", rig) for folder in (made, out))
    assert (recorded.channels["q11"] == predicted.channels["q11"]).all()
    assert abs(recorded.channels["fx1"] - predicted.channels["fx1"]).mean() < 0.05


@pytest.mark.parametrize(("more", "message"), [
    (["--output", "."], "would replace the input"),
    (["--replay", "trial.csv", "--trials", "2"], "goes with neither"),
    (["--properties", "none.json"], "none.json: no such file"),
    (["--operator", "operator.toml"], "unknown key; expected one of")])  # fmt: skip
def test_what_is_refused_writes_nothing(tmp_path, inputs, more, message, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "operator.toml").write_text("gripp = 2.0\n")
    before = sorted(tmp_path.iterdir())
    assert main(["simulate", *inputs, *more]) == 2 and message in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_the_operator_does_as_told(tmp_path, inputs, monkeypatch):
    monkeypatch.setattr(animation, "FRAMES", 2.0)
    (tmp_path / "operator.toml").write_text("grip = 1.5\ntremor = 0.0\nwander = [0.0, 0.0]\n")
    args = ["simulate", *inputs, "--operator", str(tmp_path / "operator.toml")]
    assert main([*args, "--output", str(tmp_path / "out"), "--animation"]) == 0
    trial = read_trial(tmp_path / "out/trial_01.csv", read_rig(tmp_path / "rig.toml"))
    touch, leave = json.loads((tmp_path / "out/truth/trial_01.json").read_text())["boundaries"][:2]
    held = (trial.t > leave + 0.2) & (trial.t < leave + 0.8)
    assert leave > touch
    grip = (trial.channels["fx1"] - trial.channels["fx2"])[held] / 2
    assert grip.mean() == pytest.approx(1.5, abs=0.06)
    with Image.open(tmp_path / "out/trial_01.gif") as film:
        assert film.n_frames == pytest.approx(trial.t[-1] * 2.0, abs=2)
