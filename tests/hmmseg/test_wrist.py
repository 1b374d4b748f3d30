"""A gripper with a wrist sensor; planted faults of any hand, each reported with the line that mends it."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from fault_scene import CARTESIAN, FOLDER, FREE, JOINT, JOINTED, mended
from refusals import refused

from estimation import identify
from estimation.checks import dense
from estimation.identification import identify_aligned
from experiments.wrist import ARM_RIG, SETUPS
from experiments.wrist_scene import BLOCKS, TASK, Setup, performances, wrist_recording, wrist_rig
from hmmseg.errors import InputError
from hmmseg.hand.grips import closings, grip_of
from hmmseg.hand.read import read_trial
from hmmseg.hand.tool import applied_force, free_tool, pose_of
from hmmseg.io.rig import parse_rig, read_rig
from hmmseg.io.table import frame_table
from hmmseg.io.task import read_task
from hmmseg.io.trial import trial_of
from hmmseg.robust import coarse_step
from hmmseg.segmentation.align import align
from hmmseg.segmentation.emissions import noise_sd

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
        assert found.of(obj, "width").mean() == pytest.approx(block.width, abs=2e-4)
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
    usual, holes = read_trial(columns, wrist_rig(PLAIN)), (columns["t"] >= 4.0) & (columns["t"] < 4.06)
    gone = {name: np.where(holes, np.nan, columns[name]) for name in ("gap", "pz", "Fz")}
    holed = read_trial(columns | gone, wrist_rig(PLAIN))
    assert np.isnan(holed.channels["fy1"][holes]).all()
    assert np.nanmax(np.abs(holed.channels["fy1"] - usual.channels["fy1"])) < 0.1
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
def test_what_cannot_be_is_refused_in_one_line(performed, setup, said, change, line):
    columns = wrist_recording(performed[0], setup)
    for name, factor in change.items():
        columns[name] = columns[name] * factor
    refused(line, read_trial, columns, wrist_rig(setup, **said))


@pytest.mark.parametrize("step", [4e-4, 1e-3])
def test_an_opening_in_coarse_steps_leaves_widths_uncertain_and_not_wrong(performed, step):
    columns = wrist_recording(performed[0], PLAIN)
    trial = read_trial(columns | {"gap": np.round(columns["gap"] / step) * step}, wrist_rig(PLAIN))
    assert any(f"gap in steps of {1e3 * step:g} mm" in line for line in trial.warnings)
    found = identify(trial, TASK, wrist_rig(PLAIN))
    for name, block in BLOCKS.items():
        width = found.of(name, "width")
        assert abs(width.mean() - block.width) < 3 * width.std()


def test_touches_are_reported_and_the_lift_shows_the_sign_of_readings_that_change_with_the_pose(performed):
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
    line = "pulls up .*expected reaction = false under"
    refused(line, read_trial, columns, wrist_rig(setup, reaction=True))


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


DEG = 180 / np.pi
GF, KGF = 9.80665e-3, 9.80665
FORCES = ("fx1", "fy1", "fx2", "fy2")
SWAYING = Setup(heading=0.9, tilt=0.1, offset=(1.0, 2.0, 3.0), reaction=True)
REFUSED = {
    "y and z exchanged": ({"position": {"y": "pz", "z": "py"}}, lambda c: c,
                          "pulls along y and never along z: .* expected position = {y"),
    "z down": ({}, lambda c: scaled(c, ["pz"], -1.0), r'counted downwards; expected up = "-z" under'),
    "counts closing": ({}, lambda c: c | {"gap": 0.08 - c["gap"]}, "counts how far the gripper has closed"),
    "fingers that cancel": ({"opening": ["left", "right"]},
                            lambda c: c | {"left": c["gap"] / 2, "right": -c["gap"] / 2},
                            r"left \+ right stays as it is: it counts the other way; expected right = {"),
}  # fmt: skip


def changed(table, **factors):
    out = dict(table)
    for stem, factor in factors.items():
        for name in table:
            if name == stem or re.fullmatch(rf"{stem}\d+", name):
                out[name] = table[name] * factor
    return out


LOW = changed(CARTESIAN, y=0.5, vy=0.5)
SWAP, XY = str.maketrans("12", "21"), str.maketrans("xy", "yx")
MISFITS = {
    "t in ms, rate known": (JOINT, changed(JOINT, t=1e3), JOINTED, r"column t: .*rate = 20 .*looks like ms"),
    "t in us": (CARTESIAN, changed(CARTESIAN, t=1e6), FREE, "column t: .*looks like us"),
    "t in ns": (CARTESIAN, changed(CARTESIAN, t=1e9), FREE, "column t: .*looks like ns"),
    "ms since 1970": (JOINT, {**JOINT, "t": (JOINT["t"] + 1.764e9) * 1e3}, JOINTED, "looks like ms"),
    "positions in mm": (CARTESIAN, changed(CARTESIAN, x=1e3, y=1e3), FREE, "travels .*looks like mm"),
    "all in mm": (CARTESIAN, changed(CARTESIAN, x=1e3, y=1e3, vx=1e3, vy=1e3), FREE, "looks like mm"),
    "positions in cm": (CARTESIAN, changed(CARTESIAN, x=1e2, y=1e2), FREE, "looks like cm"),
    "low lifts in cm": (LOW, changed(LOW, x=1e2, y=1e2, vx=1e2, vy=1e2), FREE, "it looks like cm"),
    "x1 alone in mm": (CARTESIAN, {**CARTESIAN, "x1": CARTESIAN["x1"] * 1e3}, FREE, "column x1: travels"),
    "velocities in mm/s": (CARTESIAN, changed(CARTESIAN, vx=1e3, vy=1e3), FREE, "times what x1 changes by"),
    "angles in deg": (JOINT, changed(JOINT, q=DEG, dq=DEG), JOINTED, "turns of a link: it looks like deg"),
    "angles in deg, rates in rad/s": (JOINT, changed(JOINT, q=DEG), JOINTED, "it looks like deg"),
    "rates in deg/s": (JOINT, changed(JOINT, dq=DEG), JOINTED, "times what q11 changes by"),
    "fingers swapped": (CARTESIAN, {n.translate(SWAP): v for n, v in CARTESIAN.items()}, FREE,
                        "column x1: .*the fingers are swapped"),
    "forces on the fingers": (JOINT, changed(JOINT, fx=-1, fy=-1), JOINTED, "on the finger, not by it"),
    "fx flipped": (JOINT, changed(JOINT, fx=-1), JOINTED, "column fx1: is negative and fx2 positive"),
    "fy flipped": (JOINT, changed(JOINT, fy=-1), JOINTED, "column fy1: and fy2 are negative in sum while"),
    "fx2 flipped": (JOINT, {**JOINT, "fx2": -JOINT["fx2"]}, JOINTED, "column fx2: fx1 and fx2 push the same"),
    "fx1 flipped": (JOINT, {**JOINT, "fx1": -JOINT["fx1"]}, JOINTED, "column fx1: fx1 and fx2 push the same"),
    "x and y": (CARTESIAN, {n.translate(XY): v for n, v in CARTESIAN.items()}, FREE,
                "column x1: and y are exchanged"),
    "x and y of forces": (CARTESIAN, {n.translate(XY) if n[0] == "f" else n: v for n, v in CARTESIAN.items()},
                          FREE, "column fx1: and y are exchanged: the fingers press against each"),
    "x and y of places": (CARTESIAN, {n if n[0] == "f" else n.translate(XY): v for n, v in CARTESIAN.items()},
                          FREE, "column x1: .* stand apart in a grip"),
    "x flipped": (CARTESIAN, changed(CARTESIAN, x=-1, vx=-1), FREE, "column x1: is right of x2 in a grip"),
}  # fmt: skip


@pytest.mark.parametrize("case", MISFITS)
def test_refused_with_what_mends_it(case):
    healthy, table, rig, line = MISFITS[case]
    caught = refused(line, read_trial, table, rig)
    better, rounds = mended(rig, caught), 0
    while True:  # one thing a time: velocities are looked at when positions are right
        try:
            trial = read_trial(table, better)
            break
        except InputError as error:
            rounds += 1
            assert rounds < 3, error
            more = mended(rig, str(error)).columns
            better = better.model_copy(update={"columns": {**better.columns, **more}})
    expected = read_trial(healthy, rig)
    for name, values in expected.channels.items():
        np.testing.assert_allclose(trial.channels[name], values, rtol=1e-9, atol=1e-9, err_msg=name)


def test_seconds_since_1970_the_hands_weight_and_y_that_points_down_are_reported():
    trial = read_trial({**JOINT, "t": JOINT["t"] + 1764000000.25}, JOINTED)
    assert trial.t[0] == 1764000000.25
    (line,) = trial.warnings
    assert re.search(r"column t counts seconds since 1970 \(from 2025-11-24T16:00:00\)", line)
    again = read_trial({**JOINT, "t": JOINT["t"] + 1764000000.25}, mended(JOINTED, line))
    assert (again.t[0], again.warnings) == (0.25, ())
    table = {**JOINT, "fy1": JOINT["fy1"] - 2.5, "fy2": JOINT["fy2"] - 2.5}
    (line,) = read_trial(table, JOINTED).warnings
    assert re.search(r"column fy1 and fy2 sum to -5\S* N before the first touch, a lift adds .* gravity or",
                     line)  # fmt: skip
    again = read_trial(table, mended(JOINTED, line))
    assert again.warnings == ()
    np.testing.assert_allclose(again.channels["fy1"], JOINT["fy1"], atol=0.05)
    (line,) = read_trial(changed(CARTESIAN, y=-1, vy=-1, fy=-1), FREE).warnings
    assert re.search("column y1 every hold first goes down .*y points down; expected y1 = ", line)


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "mN"), (1e-3, "kN")])
def test_forces_of_another_size_are_remarked_on(factor, unit):
    warnings = read_trial(changed(JOINT, fx=factor, fy=factor), JOINTED).warnings
    assert any(f'unit = "{unit}"' in warning for warning in warnings), warnings


def test_what_stands_still_repeats_or_drifts_is_taken_for_nothing_else():
    rng = np.random.default_rng(0)
    still = {name: np.full(80, np.nanmean(values)) + 2e-5 * rng.standard_normal(80)
             for name, values in CARTESIAN.items()} | {"t": 0.05 * np.arange(80)}  # fmt: skip
    assert not read_trial(still, FREE).warnings
    tiny = changed(CARTESIAN, x=1e-3, y=1e-3, vx=1e-3, vy=1e-3)
    assert any("as if they were in km" in line for line in read_trial(tiny, FREE).warnings)
    trial = read_trial({**CARTESIAN, "x1": np.full_like(CARTESIAN["x1"], 0.1)}, FREE)
    assert any("x1 reads 0.1 in every row" in line for line in trial.warnings)
    drift = np.linspace(0, -3, JOINT["t"].size)
    read_trial({**JOINT, "fy1": JOINT["fy1"] + drift, "fy2": JOINT["fy2"] + drift}, JOINTED)
    flipped = {**JOINT, "fy1": -JOINT["fy1"] - drift, "fy2": -JOINT["fy2"] - drift}
    refused("negative in sum while a block is lifted", read_trial, flipped, JOINTED)
    both = {**JOINT, "fx2": JOINT["fx1"], "fy2": JOINT["fy1"]}  # such a hand has no tips to read as halves
    refused("fx1 and fx2 push the same way", read_trial, both, JOINTED)


def test_coarse_steps_are_distinguished_from_stuck_positions_and_from_motion():
    rounded = {name: np.round(values, 3) if name[0] in "xy" else values for name, values in CARTESIAN.items()}
    trial = read_trial(rounded, parse_rig({"noise": {"position": 2e-5}}))
    assert any("in steps of 1 mm" in line for line in trial.warnings)
    assert trial.step == pytest.approx((1e-3, 1e-3))
    assert not any(re.match(r".*: [xy]\d repeats", line) for line in trial.warnings)
    assert read_trial(CARTESIAN, FREE).step == (0, 0)
    rng, place = np.random.default_rng(0), np.abs(np.linspace(-0.3, 0.3, 1500)).clip(0.1)
    read = place + rng.normal(0, 2e-5, place.size)
    assert coarse_step(read) == coarse_step(np.round(read, 5)) == 0
    assert coarse_step(np.round(read, 4)) == pytest.approx(1e-4)
    assert noise_sd(np.round(read, 4)) >= 1e-4 / np.sqrt(12) * 0.999


@pytest.mark.parametrize("name", ["x2", "y1"])
def test_a_position_stuck_for_most_of_a_recording_is_not_taken_for_coarse_steps(name):
    values = CARTESIAN[name].copy()
    values[values.size // 4 :] = values[values.size // 4]
    table = {k: v for k, v in CARTESIAN.items() if k[0] != "v"} | {name: values}
    trial = read_trial(table, parse_rig({"noise": {"position": 2e-5}}))
    assert any(re.match(rf".*: {name} repeats", line) for line in trial.warnings)
    assert not any("in steps of" in line for line in trial.warnings)


def test_hands_of_other_than_two_fingers_are_reported():
    table = CARTESIAN | {"fx3": CARTESIAN["fx2"]}
    line = "columns fx3 are left out: hands have two fingers"
    assert any(line in warning for warning in read_trial(table, FREE).warnings)
    one = {name: values for name, values in table.items() if name[-1] != "2"}
    refused("as all of finger 2", read_trial, one, FREE)


@pytest.mark.parametrize("case", ["none_1", "none_2", "paper_blocks", "force_bias_1", "grip_slip_1"])
def test_quiet_on_what_the_project_commits(case):
    folder = FOLDER.parent / case
    rig = read_rig(folder / "rig.toml")
    for file in sorted(folder.glob("trial_*.csv")):
        assert read_trial(file, rig).warnings == ()


@pytest.mark.parametrize("pace", [0.2, 0.5, 2.0, 4.0])
@pytest.mark.parametrize("scale", [0.2, 1.0, 3.0])
def test_quiet_at_other_paces_and_sizes(pace, scale):
    table = {name: values.copy() for name, values in CARTESIAN.items()}
    for name in table:
        table[name] *= scale * pace if name[0] == "v" else scale if name[0] in "xy" else 1.0
    table["t"] /= pace
    assert read_trial(table, FREE).warnings == ()


def test_quiet_on_everything_shared(shared):
    warned = [str(file.relative_to(shared))
              for kind in ("recordings", "recordings_general", "recordings_spent", "panda")
              for rig_file in sorted((shared / kind).glob("*/rig.toml"))
              for file in sorted(rig_file.parent.glob("trial_*.csv"))
              if read_trial(file, read_rig(rig_file)).warnings]  # fmt: skip
    assert {Path(name).parent.name for name in warned} == {"wrist_untared"}  # and it should be


def scaled(columns, names, factor):
    return columns | {name: columns[name] * factor for name in names}


@pytest.mark.parametrize(("unit", "size"), [("gf", GF), ("kgf", KGF)])
def test_forces_whose_noise_is_another_units(unit, size):
    rng = np.random.default_rng(0)
    table = CARTESIAN | {name: CARTESIAN[name] + 0.05 * rng.normal(size=CARTESIAN["t"].size)
                         for name in FORCES}  # fmt: skip
    rig = parse_rig({"noise": {"force": 0.05}})
    assert read_trial(table, rig).warnings == ()
    (line,) = read_trial(scaled(table, FORCES, 1 / size), rig).warnings
    assert re.search(rf"column fx1 has noise of .* force = 0.05 N in rig.toml: it looks like {unit}", line)
    again = read_trial(scaled(table, FORCES, 1 / size), mended(rig, line))
    assert again.warnings == ()
    np.testing.assert_allclose(again.channels["fy2"], table["fy2"])


def test_healthy_but_filtered_forces_and_dense_blocks_are_distinguished_by_their_units():
    rng = np.random.default_rng(0)
    noise = 0.05 * rng.normal(size=(4, CARTESIAN["t"].size + 40))
    smooth = np.stack([np.convolve(n, np.full(41, 1 / 41), "valid") for n in noise])
    table = CARTESIAN | {name: CARTESIAN[name] + n for name, n in zip(FORCES, smooth, strict=True)}
    assert read_trial(table, parse_rig({"noise": {"force": 0.05}})).warnings == ()
    task, rig = TASK, parse_rig({})
    healthy = {("a", "weight"): 0.9, ("a", "width"): 0.031, ("a", "height"): 0.024}
    assert dense(task, rig, healthy) == []
    (line,) = dense(task, rig, healthy | {("a", "weight"): 0.9 / GF})
    heavy = r"a weighs 91.8 N at 31 x 24 mm: of steel it would be 1.6 m deep, so forces look like gf"
    assert re.search(heavy, line)
    assert mended(rig, line).columns["fy2"].unit == "gf"
    (line,) = dense(task, rig, {("b", "weight"): 500.0, ("b", "width"): 0.04})
    assert "forces look like mN" in line
    assert dense(task, rig, {("a", "weight"): 20.0, ("a", "width"): 0.05}) == []  # a bar of steel, 0.1 m deep


WRISTS = {
    "tool of 80 kg": (PLAIN, {}, lambda c: scaled(c, ("Fx", "Fy", "Fz"), 1 / GF), "they look like gf"),
    "tool of 800 kg": (PLAIN, {}, lambda c: scaled(c, ("Fx", "Fy", "Fz"), 1e3), "they look like mN"),
    "tool of 76 g": (PLAIN, {}, lambda c: scaled(c, ("Fx", "Fy", "Fz"), 1 / KGF), "they look like kgf"),
    "not the stated tool": (PLAIN, {"tool_mass": 0.7}, lambda c: scaled(c, ("Fx", "Fy", "Fz"), 1 / KGF),
                            r"0\.7 kg in rig\.toml.: they look like kgf"),
    "w, x, y, z": (SWAYING, {}, lambda c: c | {f"q{a}": c[f"q{b}"] for a, b in ("xw", "yx", "zy", "wz")},
                   r'better as w, x, y, z; expected quaternion = \["qy", "qz", "qw", "qx"\] under'),
    "another mass": (PLAIN, {"tool_mass": 2.0}, lambda c: c,
                     r"is stated to weigh 2 kg and moves like one of 0\.7\d* kg"),
    "one finger": (PLAIN, {"opening": "finger_1"}, lambda c: c | {"finger_1": c["gap"] / 2},
                   r'halved; expected finger_1 = \{from = "finger_1", unit = 2.0\} under \[columns\]'),
}  # fmt: skip


@pytest.mark.parametrize("name", WRISTS)
def test_what_is_unlikely_of_a_wrist_is_reported(performed, name):
    setup, said, change, line = WRISTS[name]
    (told,) = read_trial(change(wrist_recording(performed[0], setup)), wrist_rig(setup, **said)).warnings
    assert re.search(line, told), told
    assert "\n" not in told


@pytest.mark.parametrize("setup", [PLAIN, SWAYING])
def test_nothing_is_reported_of_a_healthy_wrist(performed, setup):
    columns = wrist_recording(performed[0], setup)
    assert read_trial(columns, wrist_rig(setup)).warnings == ()
    assert read_trial(columns, wrist_rig(setup, tool_mass=0.7)).warnings == ()


def test_the_lines_mend_what_they_refuse(performed):
    healthy = read_trial(wrist_recording(performed[0], PLAIN), wrist_rig(PLAIN))
    for said, change, line in REFUSED.values():
        columns = change(wrist_recording(performed[0], PLAIN))
        table = wrist_rig(PLAIN, **said).model_dump(exclude_none=True, exclude_defaults=True)
        told = refused(line, read_trial, columns, parse_rig(table))
        entry = tomllib.loads(re.sub(r" under \[\w+\].*", "", told.split("; expected ")[1]))
        if "under [gripper]" in told:
            table["gripper"] |= entry
        else:
            table["columns"] = entry
        trial = read_trial(columns, parse_rig(table))
        for name in ("fy1", "y1"):
            np.testing.assert_allclose(np.abs(trial.channels[name]), np.abs(healthy.channels[name]),
                                       atol=0.02)  # fmt: skip
