"""A gripper with a wrist sensor: recordings made with known blocks, tools and mountings."""

import json

import numpy as np
import pytest
from refusals import refused

from estimation import identify
from estimation.identification import identify_aligned
from experiments.wrist import ARM_RIG, SETUPS
from experiments.wrist_scene import BLOCKS, TASK, Setup, performances, wrist_recording, wrist_rig
from hmmseg.errors import InputError
from hmmseg.hand.grips import closings, grip_of
from hmmseg.hand.read import read_trial
from hmmseg.hand.tool import applied_force, free_tool, pose_of
from hmmseg.io.rig import parse_rig
from hmmseg.io.table import frame_table
from hmmseg.io.task import read_task
from hmmseg.io.trial import trial_of
from hmmseg.segmentation.align import align

PLAIN = Setup()


@pytest.fixture(scope="module")
def performed():
    return performances(2)


@pytest.mark.parametrize(
    "name",
    ["as it is", "reaction, untared", "all said", "turning, untared", "world's axes, drifting",
     "poor sensors", "500 Hz"])  # fmt: skip
def test_blocks_and_boundaries_from_the_wrist_alone(performed, name):
    setup, said = SETUPS[name]
    rig = wrist_rig(setup, **said)
    trials = [read_trial(wrist_recording(s, setup, i), rig) for i, s in enumerate(performed)]
    aligned, errors = align(trials, TASK, rig), []
    for simulated, found in zip(performed, aligned.segmentations, strict=True):
        assert found.failed is None
        errors += list(np.abs([s.end for s in found.spans[:-1]] - simulated.boundaries))
    assert np.median(errors) < 0.03
    found = identify_aligned(aligned)
    for obj, block in BLOCKS.items():
        weight = found.of(obj, "weight")
        assert weight.mean() == pytest.approx(block.weight, abs=max(0.02 * block.weight, 2 * weight.std()))
        assert found.of(obj, "height").mean() == pytest.approx(block.height, rel=0.005)
        for prop in ("weight", "width"):
            draws = found.of(obj, prop)
            assert abs(draws.mean() - getattr(block, prop)) < 3 * draws.std()
        assert found.of(obj, "width").std() > 1e-4  # what the pads give is not measured
        assert "wrist" in found.reasons[f"{obj}.friction"]


@pytest.mark.parametrize("after", range(1, 6))
def test_a_recording_may_end_as_it_grips(after):
    t = np.arange(50) / 50
    opening = np.maximum(0.05 - 0.04 * np.maximum(t - 0.5, 0), 0.05 - 0.04 * (t[-after] - 0.5))
    (closing,) = closings(opening)
    grip = grip_of(t, opening, closing, None, 3000.0)
    assert grip is None or opening[-1] <= grip.width <= 0.05


def creeping_grip(creep):
    """Time and opening of a gripper that closes within 1 s, holds for 3 s while it creeps [m], and opens."""
    t = np.arange(0.0, 5.0, 0.01)
    way = np.clip(t, 0, 1) - np.clip(t - 4, 0, 1)
    shut = way**3 * (10 - 15 * way + 6 * way**2)
    return t, 0.08 - 0.03 * shut + creep * np.clip((t - 1) / 3, 0, 1) * (t < 4.0)


def test_a_grip_ends_where_the_opening_passes_the_width_however_slow_its_messages():
    t, opening = creeping_grip(0.0)
    (closing,) = closings(opening)
    grip = grip_of(t, opening, closing, 2.0, 4000.0)  # the pads give 1 mm
    assert opening[grip.start] <= grip.width < opening[grip.start - 1]
    assert opening[grip.stop - 1] <= grip.width < opening[grip.stop]
    rows = np.arange(0.0, t[-1], 0.001)
    for seed in range(5):
        noisy = opening + np.random.default_rng(seed).normal(0, 1e-4, t.size)
        shown = np.interp(rows, t, noisy)
        own, joined = (grip_of(at, x, closings(x)[0], None, np.inf) for at, x in ((t, noisy), (rows, shown)))
        assert joined.width_sd == pytest.approx(own.width_sd, rel=0.1)
        assert joined.width == pytest.approx(own.width, abs=own.width_sd)


@pytest.mark.parametrize("creep", [-2e-4, 2e-4])
def test_a_grip_force_without_a_stiffness_does_not_tell_the_touch(creep):
    """Pads that nobody has measured are no rigid ones, of which every creep would be a touch."""
    t, opening = creeping_grip(creep)
    (closing,) = closings(opening)
    grip = grip_of(t, opening, closing, 8.0, np.inf)
    assert t[grip.start] < 1.1 and t[grip.stop] > 3.9 and grip.width_sd > 1e-4


def test_a_grip_force_tells_the_width_and_bounds_friction(performed):
    setup = PLAIN
    rig, trials = wrist_rig(setup, grip_force="grip"), []
    for i, simulated in enumerate(performed):
        columns, pads = wrist_recording(simulated, setup, i), simulated.motion.force
        squeeze = (pads[:, 0, 0] - pads[:, 1, 0]) / 2
        columns["grip"] = np.interp(columns["t"], simulated.t, np.maximum(squeeze, 0))
        trials.append(read_trial(columns, rig))
    found = identify_aligned(align(trials, TASK, rig))
    for obj, block in BLOCKS.items():
        draws = found.of(obj, "width")
        assert draws.mean() == pytest.approx(block.width, abs=2e-4)
        assert found.friction[obj].lower_bound is not None


def test_the_tool_is_found_from_free_motion(performed):
    setup = Setup(mass=1.3, heading=0.5, tilt=0.15, offset=(4.0, -1.0, 2.0), reaction=True, noise=0.002)
    rig = wrist_rig(setup)
    trial = trial_of(frame_table(wrist_recording(performed[0], setup), None), rig, None)
    pose, free = pose_of(trial, rig.gripper), trial.t < 1.5
    tool = free_tool(trial, rig, pose, free)
    assert tool.mass == pytest.approx(1.3, rel=0.03) and np.linalg.det(tool.axes) == pytest.approx(-1)
    np.testing.assert_allclose(tool.axes, -np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), atol=0.1)
    np.testing.assert_allclose(tool.offset, setup.offset, atol=0.4)
    force = applied_force(trial, rig, pose, tool)[free]
    assert np.sqrt((force**2).mean()) < 0.1  # of a tool that weighs 13 N
    assert np.abs(force.mean(axis=0)).max() < 0.01


@pytest.mark.parametrize("late", [-0.04, 0.02, 0.06, 0.14])
def test_the_tool_is_found_where_forces_come_late(performed, late):
    """Late by more than an acceleration lasts, where its tangent says nothing of it."""
    columns = wrist_recording(performed[0], PLAIN)
    t, rig = columns["t"], wrist_rig(PLAIN)
    delayed = {f"F{axis}": np.interp(t - late, t, columns[f"F{axis}"]) for axis in "xyz"}

    def found(columns):
        trial = trial_of(frame_table(columns, None), rig, None)
        return free_tool(trial, rig, pose_of(trial, rig.gripper), (t > 0.2) & (t < 1.5))

    tool, usual = found(columns | delayed), found(columns)
    assert tool.delay == pytest.approx(-late, abs=1e-3)
    assert tool.inertia == pytest.approx(usual.inertia, rel=0.05) and tool.noise < 1.2 * usual.noise


def test_an_open_hand_at_rest_holds_nothing():
    setup = Setup(rate=20.0, reaction=True, offset=(3.0, -2.0, 8.0))
    simulated = performances(1, seed=104)[0]
    trial = read_trial(wrist_recording(simulated, setup, 4), wrist_rig(setup))
    assert trial.channels["x2"][0] - trial.channels["x1"][0] == pytest.approx(BLOCKS["b"].width, abs=1e-4)
    held = np.zeros(trial.t.size, bool)
    for start, _, _, end in simulated.boundaries.reshape(2, 4):
        held |= (trial.t > start) & (trial.t < end)
    assert not (trial.free * held).any() and trial.free[~held].mean() > 0.8
    (found,) = align([trial], TASK, wrist_rig(setup)).segmentations
    assert found.failed is None
    assert np.abs([s.end for s in found.spans[:-1]] - simulated.boundaries).max() < 0.05


def test_missing_samples_and_places_that_never_change_are_bridged(performed):
    columns = wrist_recording(performed[0], PLAIN)
    whole = read_trial(columns, wrist_rig(PLAIN))
    for name in ("gap", "pz", "Fz"):
        columns[name] = columns[name].copy()
        columns[name][200:203] = np.nan
    holed = read_trial(columns, wrist_rig(PLAIN))
    assert np.isnan(holed.channels["fy1"][200:203]).all()
    assert np.nanmax(np.abs(holed.channels["fy1"] - whole.channels["fy1"])) < 0.1
    columns = wrist_recording(performed[0], PLAIN)
    usual = read_trial(columns, wrist_rig(PLAIN))
    still = read_trial(columns | {"px": np.full_like(columns["px"], 0.5)}, wrist_rig(PLAIN))
    np.testing.assert_allclose(still.channels["fy1"], usual.channels["fy1"], atol=0.05)


@pytest.mark.parametrize(("setup", "said", "change", "line"), [
    (PLAIN, {"reaction": True, "sensor_axes": ["y", "x", "-z"]}, {}, "reaction = false under"),
    (PLAIN, {}, {"pz": 1e3, "py": 1e3, "px": 1e3}, r'pz = \{from = "pz", unit = "mm"\}'),
    (PLAIN, {}, {"gap": 1e3}, r'looks like mm \(or %\); expected gap = \{from = "gap", unit = "mm"\}'),
    (PLAIN, {}, {"gap": -1.0},
     r"counts how far the gripper has closed; expected gap = \{from = .gap., sign = -1"),
    (Setup(heading=0.3), {}, {"qw": 2.0}, "a quaternion of norm .*expected a norm of 1"),
    (PLAIN, {}, {"t": 1e3}, r't = \{from = "t", unit = "ms"\}'),
    (PLAIN, {}, {"gap": 1e-6}, "expected a gripper that closes and opens"),
    (PLAIN, {}, {"Fz": 0.0}, "column Fz: reads -?0 in every row; expected readings of a working sensor"),
])  # fmt: skip
def test_what_cannot_be_is_told_in_one_line(performed, setup, said, change, line):
    columns = wrist_recording(performed[0], setup)
    for name, factor in change.items():
        columns[name] = columns[name] * factor
    rig = wrist_rig(setup, **said)
    refused(line, read_trial, columns, rig)


@pytest.mark.parametrize("step", [4e-4, 1e-3])
def test_an_opening_in_coarse_steps_leaves_widths_uncertain_and_not_wrong(performed, step):
    columns = wrist_recording(performed[0], PLAIN)
    trial = read_trial(columns | {"gap": np.round(columns["gap"] / step) * step}, wrist_rig(PLAIN))
    assert any(f"gap in steps of {1e3 * step:g} mm" in line for line in trial.warnings)
    found = identify(trial, TASK, wrist_rig(PLAIN))
    for name, block in BLOCKS.items():
        width = found.of(name, "width")
        assert abs(width.mean() - block.width) < 3 * width.std()


def test_touches_are_told_and_the_lift_tells_the_sign_of_readings_that_change_with_the_pose(performed):
    columns = wrist_recording(performed[0], PLAIN)
    pressed = (columns["t"] > 1.2) & (columns["t"] < 1.5)
    columns["Fz"] = columns["Fz"] - np.where(pressed, -2.0, 0.0)
    notes = read_trial(columns, wrist_rig(PLAIN)).notes
    assert any("the hand touches something from 1.2" in note for note in notes)
    setup = Setup(frame="world")
    columns = wrist_recording(performed[0], setup)
    for axis in "xyz":
        if f"p{axis}" in columns:
            columns[f"F{axis}"] = columns[f"F{axis}"] + 300.0 * (columns[f"p{axis}"] - columns[f"p{axis}"][0])
    trials = [read_trial(columns, wrist_rig(setup, **said)) for said in ({}, {"reaction": False})]
    for trial in trials:
        assert any("go against the hand's own acceleration" in each for each in trial.warnings)
        assert not any("tool of -" in note for note in trial.notes)
    np.testing.assert_allclose(trials[0].channels["fy1"], trials[1].channels["fy1"])
    with pytest.raises(InputError, match=r"pulls up .*expected reaction = false under"):
        read_trial(columns, wrist_rig(setup, reaction=True))


def test_halves_of_a_wrist_are_no_fingers(performed):
    simulated = performed[0]
    t = np.arange(int(simulated.t[-1] * 50)) / 50
    motion, columns = simulated.motion, {"t": t}
    net = motion.force.sum(axis=1)
    for i in (0, 1):
        for k, axis in enumerate("xy"):
            columns[f"{axis}{i + 1}"] = np.interp(t, simulated.t, motion.position[:, i, k])
            columns[f"f{axis}{i + 1}"] = np.interp(t, simulated.t, net[:, k] / 2) - 2.5 * k
    rig = parse_rig({"fingertip": wrist_rig(PLAIN).fingertip.model_dump()})
    trial = read_trial(columns, rig)
    assert any("half of a wrist's force" in note for note in trial.notes)
    found = identify_aligned(align([trial], TASK, rig))
    assert found.of("a", "weight").mean() == pytest.approx(BLOCKS["a"].weight, rel=0.02)


def test_an_arm_of_another_simulator(shared):
    folder = shared / "panda" / "wrist_restack_1"
    aligned = align([read_trial(folder / f"wrist_0{k}.csv", ARM_RIG) for k in (1, 2, 3, 4)],
                    read_task(folder / "task.toml"), ARM_RIG)  # fmt: skip
    truth = [json.loads((folder / "truth" / f"trial_0{k}.json").read_text())["boundaries"]
             for k in (1, 2, 3, 4)]  # fmt: skip
    found = np.array([[span.end for span in s.spans[:-1]] for s in aligned.segmentations])
    assert np.median(np.abs(found - truth)) < 0.03
    blocks = json.loads((folder / "truth.json").read_text())
    properties = identify_aligned(aligned)
    for obj, actual in blocks.items():
        assert properties.of(obj, "weight").mean() == pytest.approx(actual["weight"], rel=0.02)
        assert properties.of(obj, "height").mean() == pytest.approx(actual["height"], abs=1e-4)
        low, high = np.percentile(properties.of(obj, "width"), [2.5, 97.5])
        assert low < actual["width"] < high
