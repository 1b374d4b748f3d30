"""Planted faults on healthy recordings: each refused or warned of with the line that mends it.

The oracle is the recording itself: written into rig.toml, the proposed entries give it back.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from fault_scene import CARTESIAN, FOLDER, FREE, JOINT, JOINTED, mended

from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import read_rig


def changed(table, **factors):
    """The table with each named column (or all that begin so) times a factor."""
    out = dict(table)
    for stem, factor in factors.items():
        for name in table:
            if name == stem or re.fullmatch(rf"{stem}\d+", name):
                out[name] = table[name] * factor
    return out


def swapped(table):
    return {name[:-1] + {"1": "2", "2": "1"}[name[-1]] if name[-1] in "12" else name: values
            for name, values in table.items()}  # fmt: skip


DEG = 180 / np.pi
MISFITS = {
    "t in ms, rate known": (JOINT, changed(JOINT, t=1e3), JOINTED, r"column t: .*rate = 20 .*looks like ms"),
    "t in us": (CARTESIAN, changed(CARTESIAN, t=1e6), FREE, "column t: .*looks like us"),
    "t in ns": (CARTESIAN, changed(CARTESIAN, t=1e9), FREE, "column t: .*looks like ns"),
    "ms since 1970": (JOINT, {**JOINT, "t": (JOINT["t"] + 1.764e9) * 1e3}, JOINTED, "looks like ms"),
    "positions in mm": (CARTESIAN, changed(CARTESIAN, x=1e3, y=1e3), FREE, "travels .*looks like mm"),
    "all in mm": (CARTESIAN, changed(CARTESIAN, x=1e3, y=1e3, vx=1e3, vy=1e3), FREE, "looks like mm"),
    "positions in cm": (CARTESIAN, changed(CARTESIAN, x=1e2, y=1e2), FREE, "looks like cm"),
    "x1 alone in mm": (CARTESIAN, {**CARTESIAN, "x1": CARTESIAN["x1"] * 1e3}, FREE, "column x1: travels"),
    "velocities in mm/s": (CARTESIAN, changed(CARTESIAN, vx=1e3, vy=1e3), FREE, "times what x1 changes by"),
    "angles in deg": (JOINT, changed(JOINT, q=DEG, dq=DEG), JOINTED, "turns of a link: it looks like deg"),
    "angles in deg, rates in rad/s": (JOINT, changed(JOINT, q=DEG), JOINTED, "it looks like deg"),
    "rates in deg/s": (JOINT, changed(JOINT, dq=DEG), JOINTED, "times what q11 changes by"),
    "fingers swapped": (CARTESIAN, swapped(CARTESIAN), FREE, "column x1: .*the fingers are swapped"),
    "forces on the fingers": (JOINT, changed(JOINT, fx=-1, fy=-1), JOINTED, "on the finger, not by it"),
    "fx flipped": (JOINT, changed(JOINT, fx=-1), JOINTED, "column fx1: is negative and fx2 positive"),
    "fy flipped": (JOINT, changed(JOINT, fy=-1), JOINTED, "column fy1: and fy2 are negative in sum while"),
    "fx2 flipped": (JOINT, {**JOINT, "fx2": -JOINT["fx2"]}, JOINTED, "column fx2: fx1 and fx2 push the same"),
    "fx1 flipped": (JOINT, {**JOINT, "fx1": -JOINT["fx1"]}, JOINTED, "column fx1: fx1 and fx2 push the same"),
    "x flipped": (CARTESIAN, changed(CARTESIAN, x=-1, vx=-1), FREE, "column x1: is right of x2 in a grip"),
}  # fmt: skip


@pytest.mark.parametrize("case", MISFITS)
def test_refused_with_what_mends_it(case):
    healthy, table, rig, line = MISFITS[case]
    with pytest.raises(InputError, match=line) as caught:
        read_trial(table, rig)
    assert "\n" not in str(caught.value)
    better, rounds = mended(rig, str(caught.value)), 0
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


def test_seconds_since_1970_are_kept_and_told():
    trial = read_trial({**JOINT, "t": JOINT["t"] + 1764000000.25}, JOINTED)
    assert trial.t[0] == 1764000000.25
    (line,) = trial.warnings
    assert re.search(r"column t counts seconds since 1970 \(from 2025-11-24T16:00:00\)", line)
    again = read_trial({**JOINT, "t": JOINT["t"] + 1764000000.25}, mended(JOINTED, line))
    assert (again.t[0], again.warnings) == (0.25, ())


def test_the_hands_own_weight_is_told():
    table = {**JOINT, "fy1": JOINT["fy1"] - 2.5, "fy2": JOINT["fy2"] - 2.5}
    (line,) = read_trial(table, JOINTED).warnings
    assert re.search(
        r"column fy1 and fy2 sum to -5\S* N before the first touch, a lift adds .* gravity or", line
    )
    again = read_trial(table, mended(JOINTED, line))
    assert again.warnings == ()
    np.testing.assert_allclose(again.channels["fy1"], JOINT["fy1"], atol=0.05)


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "mN"), (1e-3, "kN")])
def test_forces_of_another_size_are_remarked_on(factor, unit):
    warnings = read_trial(changed(JOINT, fx=factor, fy=factor), JOINTED).warnings
    assert any(f'unit = "{unit}"' in warning for warning in warnings), warnings


def test_y_that_points_down_is_told():
    (line,) = read_trial(changed(CARTESIAN, y=-1, vy=-1, fy=-1), FREE).warnings
    assert re.search("column y1 every hold first goes down .*y points down; expected y1 = ", line)


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
    warned = [
        str(file.relative_to(shared))
        for kind in ("recordings", "recordings_general", "recordings_spent", "panda")
        for rig_file in sorted((shared / kind).glob("*/rig.toml"))
        for file in sorted(rig_file.parent.glob("trial_*.csv"))
        if read_trial(file, read_rig(rig_file)).warnings
    ]
    assert {Path(name).parent.name for name in warned} == {"wrist_untared"}  # and it should be
