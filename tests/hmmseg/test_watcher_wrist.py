"""A gripper with a sensor in its wrist, followed while it runs: what comes in is as off line, only later."""

import io
import json
import sys

import numpy as np
import pytest

from estimation.identification import identify_aligned
from experiments.wrist_scene import BLOCKS, TASK, Setup, performances, wrist_recording, wrist_rig
from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.io.formats import read_table
from hmmseg.io.rig import parse_rig
from hmmseg.io.task import read_task
from hmmseg.io.trial import trial_of
from hmmseg.online.watcher import Watcher
from hmmseg.online.wrist import Closings
from hmmseg.segmentation.align import align

SETUP = Setup(rate=20.0, reaction=True, offset=(3.0, -2.0, 8.0))  # untared


@pytest.fixture(scope="module")
def performed():
    simulated = performances(2)[1]
    return simulated, wrist_recording(simulated, SETUP, 1)


def follow(columns, rig, task=TASK, stop=None):
    watcher = Watcher(task, rig)
    lines = []
    for k, t in enumerate(columns["t"][:stop]):
        lines.append(
            json.loads(watcher.update(float(t), {n: columns[n][k] for n in watcher.channels}).line())
        )
    return watcher, lines, json.loads(watcher.finish().line())


@pytest.fixture(scope="module")
def watched(performed):
    return follow(performed[1], wrist_rig(SETUP))


def test_the_last_answer_agrees_with_that_off_line(performed, watched):
    simulated, columns = performed
    watcher, _, final = watched
    rig = wrist_rig(SETUP)
    aligned = align([read_trial(columns, rig)], TASK, rig)
    spans, identified = aligned.segmentations[0].spans, identify_aligned(aligned)
    assert final["fits"]
    assert [c.step.name for c in watcher.crossings] == [s.subtask for s in spans[1:]]
    for crossing, span, true in zip(watcher.crossings, spans[1:], simulated.boundaries, strict=True):
        assert abs(crossing.t - span.start) < 3 * np.hypot(crossing.sd, span.start_sd)
        assert abs(crossing.t - true) < 3 * crossing.sd
    for obj, block in BLOCKS.items():
        for prop in ("weight", "width", "height"):
            found, draws = final["properties"][obj][prop], identified.of(obj, prop)
            assert abs(found["mean"] - draws.mean()) < 3 * np.hypot(found["sd"], draws.std())
            assert abs(found["mean"] - getattr(block, prop)) < 3 * found["sd"]
        assert final["properties"][obj]["width"]["sd"] > 1e-4  # what the pads give is not measured


def test_nothing_is_known_before_the_first_grip_and_nothing_is_looked_ahead(performed, watched):
    _, columns = performed
    _, lines, _ = watched
    first = next(i for i, line in enumerate(lines) if line["properties"])
    assert lines[first]["t"] > 2.0  # it grips at 2.4 s
    assert all(line["subtask"] == "pregrasp" and line["probabilities"][0] == 1 for line in lines[:20])
    cut = 150
    ahead = columns | {name: np.r_[c[:cut], c[cut:][::-1]] for name, c in columns.items() if name != "t"}
    _, again, _ = follow(ahead, wrist_rig(SETUP), stop=cut)
    assert again == lines[:cut]


def test_a_gripper_that_only_pauses_has_gripped_nothing(performed):
    """A preshape before the grip looks like one; what was thought since is taken back."""
    _, columns = performed
    early = columns | {"gap": columns["gap"].copy()}
    t, gap = early["t"], early["gap"]
    before = t < 1.9
    gap[before] = np.minimum(gap[before], 0.052 - 0.006 * np.clip((t[before] - 0.7) / 0.1, 0, 1))
    watcher, _, final = follow(early, wrist_rig(SETUP))
    assert final["fits"], final["failed"]
    assert watcher.crossings[0].t > 1.9


def test_a_drifting_sensor_is_told_as_an_uncertain_weight(performed):
    simulated, _ = performed
    setup = Setup(rate=20.0, drift=0.02)
    _, _, final = follow(wrist_recording(simulated, setup, 1), wrist_rig(setup))
    for obj, block in BLOCKS.items():
        found = final["properties"][obj]["weight"]
        assert abs(found["mean"] - block.weight) < 3 * found["sd"]


def test_a_first_grip_without_free_motion_is_told(performed):
    _, columns = performed
    late = {name: c[columns["t"] > 1.7] for name, c in columns.items()}
    with pytest.raises(InputError, match="no free motion"):
        follow(late, wrist_rig(SETUP))


def test_an_opening_is_read_as_it_comes():
    """Closes at 0.1 m/s on something 30 mm wide that gives 1 mm, and opens again."""
    t = np.arange(0, 3, 0.01)
    way = 0.05 - 0.1 * np.clip(t - 0.5, 0, None)
    held = 0.029 + 0.001 * np.exp(-(t - 0.7) / 0.03)
    opening = np.where(way > 0.03, way, held) + np.where(t > 2, 0.1 * (t - 2), 0)
    closings, known = Closings(lambda t, opening: None), []
    for at, value in zip(t, opening, strict=True):
        closings.take(float(at), float(value))
        known.append(closings.known)
    assert closings.number == 1
    grip = closings.grips[-1]
    assert grip.grip.width == pytest.approx(0.03, abs=3 * grip.grip.width_sd)
    assert grip.start == pytest.approx(0.7, abs=0.03) and grip.stop == pytest.approx(2.0, abs=0.03)
    assert (np.diff(known) >= 0).all() and (t - known).max() < 0.3
    assert closings.free(0.3, 0.05) and not closings.free(1.0, 0.029)


def test_an_arm_of_another_simulator(shared):
    folder = shared / "panda" / "wrist_restack_1"
    rig = parse_rig({
        "gravity": 9.81,
        "gripper": {"position": {"y": "ee_y", "z": "ee_z"}, "opening": "width", "wrench": ["Fx", "Fy", "Fz"]},
        "columns": {"width": {"offset": -1.02e-3}},
        "fingertip": {"normal_stiffness": 3735.0, "shear_stiffness": 2500.0},
    })  # fmt: skip
    blocks = json.loads((folder / "truth.json").read_text())
    errors = []
    for k in (1, 2, 3, 4):
        raw = trial_of(read_table(folder / f"wrist_0{k}.csv", None), rig, None)
        columns = {"t": raw.t} | raw.channels
        watcher, lines, final = follow(columns, rig, read_task(folder / "task.toml"))
        assert final["fits"] and all(line["fits"] for line in lines)
        truth = json.loads((folder / "truth" / f"trial_0{k}.json").read_text())["boundaries"]
        errors += [abs(c.t - b) for c, b in zip(watcher.crossings, truth, strict=True)]
        for obj, actual in blocks.items():
            found = final["properties"][obj]
            assert found["weight"]["mean"] == pytest.approx(actual["weight"], rel=0.02)
            for prop in ("weight", "width", "height"):
                assert abs(found[prop]["mean"] - actual[prop]) < 3 * found[prop]["sd"]
    assert np.median(errors) < 0.03


def test_a_load_that_vanishes_is_told_within_half_a_second(shared):
    """As when a block drops out of the grip in mid-air; what is smoothed errs alike, but not so much."""
    folder = shared / "panda" / "wrist_restack_1"
    rig = parse_rig({
        "gravity": 9.81,
        "gripper": {"position": {"y": "ee_y", "z": "ee_z"}, "opening": "width", "wrench": ["Fx", "Fy", "Fz"]},
        "fingertip": {"normal_stiffness": 3735.0, "shear_stiffness": 2500.0},
    })  # fmt: skip
    raw = trial_of(read_table(folder / "wrist_01.csv", None), rig, None)
    columns = {"t": raw.t} | raw.channels
    gone = (raw.t > 4.36) & (raw.t < 5.78)
    columns["Fz"] = columns["Fz"] + 0.466 * gone
    _, lines, final = follow(columns, rig, read_task(folder / "task.toml"))
    assert not final["fits"]
    first = next(line["t"] for line in lines if not line["fits"])
    assert 4.36 < first < 4.86


def test_the_command_follows_a_wrist(performed, monkeypatch, capsys, tmp_path):
    from hmmseg_cli.main import main

    _, columns = performed
    (tmp_path / "task.toml").write_text(
        '[objects.a]\non = "b"\n[objects.b]\non = "ground"\n[[moves]]\nobject = "a"\nto = "ground"\n'
        '[[moves]]\nobject = "b"\nto = "a"\n'
    )
    (tmp_path / "rig.toml").write_text(
        '[gripper]\nposition = ["px", "py", "pz"]\nopening = "gap"\nwrench = ["Fx", "Fy", "Fz"]\n'
        "[fingertip]\nnormal_stiffness = 4000.0\nshear_stiffness = 2500.0\n"
    )
    rows = [
        ",".join(columns),
        *(",".join(f"{v:.9g}" for v in row) for row in zip(*columns.values(), strict=True)),
    ]
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO("\n".join(rows).encode() + b"\n")))
    code = main(["watch", "--task", str(tmp_path / "task.toml"), "--rig", str(tmp_path / "rig.toml")])
    out, err = capsys.readouterr()
    assert code == 0 and err == ""
    lines = [json.loads(line) for line in out.splitlines()]
    assert len(lines) == len(rows) and lines[-1]["fits"]
