"""Faults that another lab's mapping may have, put into healthy recordings one at a time: each gets its line.

`test_plausibility.py`, `test_other_hands.py` and `test_wrist.py` hold units, signs and sides; here are forces
and axes that mechanics alone does not tell.
"""

import re
import tomllib

import numpy as np
import pytest
from fault_scene import CARTESIAN, FREE, mended

from estimation.checks import dense
from experiments.wrist_scene import TASK, Setup, performances, wrist_recording, wrist_rig
from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import parse_rig

GF, KGF = 9.80665e-3, 9.80665
FORCES = ("fx1", "fy1", "fx2", "fy2")
PLAIN, SWAYING = Setup(), Setup(heading=0.9, tilt=0.1, offset=(1.0, 2.0, 3.0), reaction=True)


def scaled(columns, names, factor):
    return columns | {name: columns[name] * factor for name in names}


def swapped(columns, pairs):
    return columns | {a: columns[b] for pair in pairs for a, b in (pair, pair[::-1])}


@pytest.fixture(scope="module")
def performed():
    return performances(1)[0]


@pytest.mark.parametrize(
    ("pairs", "line"),
    [
        ([("fx1", "fy1"), ("fx2", "fy2")], "column fx1: and y are exchanged: the fingers press against each"),
        ([("x1", "y1"), ("x2", "y2"), ("vx1", "vy1"), ("vx2", "vy2")], "column x1: .* stand apart in a grip"),
        (
            [(f"{a}x{i}", f"{a}y{i}") for a in ("", "v", "f") for i in (1, 2)],
            "column x1: and y are exchanged",
        ),
    ],
)
def test_exchanged_axes_are_refused_with_what_mends_them(pairs, line):
    wrong = swapped(CARTESIAN, pairs)
    with pytest.raises(InputError, match=line) as told:
        read_trial(wrong, FREE)
    trial = read_trial(wrong, mended(FREE, str(told.value)))
    for name, values in read_trial(CARTESIAN, FREE).channels.items():
        np.testing.assert_array_equal(trial.channels[name], values)


@pytest.mark.parametrize(("unit", "size"), [("gf", GF), ("kgf", KGF)])
def test_forces_whose_noise_is_another_units(unit, size):
    rng = np.random.default_rng(0)
    table = CARTESIAN | {
        name: CARTESIAN[name] + 0.05 * rng.normal(size=CARTESIAN["t"].size) for name in FORCES
    }
    rig = parse_rig({"noise": {"force": 0.05}})
    assert read_trial(table, rig).warnings == ()
    (line,) = read_trial(scaled(table, FORCES, 1 / size), rig).warnings
    assert re.search(rf"column fx1 has noise of .* force = 0.05 N in rig.toml: it looks like {unit}", line)
    again = read_trial(scaled(table, FORCES, 1 / size), mended(rig, line))
    assert again.warnings == ()
    np.testing.assert_allclose(again.channels["fy2"], table["fy2"])


def test_filtered_forces_are_not_taken_for_kgf():
    rng = np.random.default_rng(0)
    noise = 0.05 * rng.normal(size=(4, CARTESIAN["t"].size + 40))
    smooth = np.stack([np.convolve(n, np.full(41, 1 / 41), "valid") for n in noise])
    table = CARTESIAN | {name: CARTESIAN[name] + n for name, n in zip(FORCES, smooth, strict=True)}
    assert read_trial(table, parse_rig({"noise": {"force": 0.05}})).warnings == ()


def test_a_block_denser_than_any_metal_is_told():
    task, rig = TASK, parse_rig({})
    healthy = {("a", "weight"): 0.9, ("a", "width"): 0.031, ("a", "height"): 0.024}
    assert dense(task, rig, healthy) == []
    (line,) = dense(task, rig, healthy | {("a", "weight"): 0.9 / GF})
    assert re.search(
        r"a weighs 91.8 N at 31 x 24 mm: of steel it would be 1.6 m deep, so forces look like gf", line
    )
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
def test_what_is_unlikely_of_a_wrist_is_told(performed, name):
    setup, said, change, line = WRISTS[name]
    (told,) = read_trial(change(wrist_recording(performed, setup)), wrist_rig(setup, **said)).warnings
    assert re.search(line, told), told
    assert "\n" not in told


@pytest.mark.parametrize("setup", [PLAIN, SWAYING])
def test_nothing_is_told_of_a_healthy_wrist(performed, setup):
    columns = wrist_recording(performed, setup)
    assert read_trial(columns, wrist_rig(setup)).warnings == ()
    assert read_trial(columns, wrist_rig(setup, tool_mass=0.7)).warnings == ()


REFUSED = {
    "y and z exchanged": ({"position": {"y": "pz", "z": "py"}}, lambda c: c,
                          "pulls along y and never along z: .* expected position = {y"),
    "z down": ({}, lambda c: scaled(c, ["pz"], -1.0), r'counted downwards; expected up = "-z" under'),
    "counts closing": ({}, lambda c: c | {"gap": 0.08 - c["gap"]}, "counts how far the gripper has closed"),
    "fingers that cancel": ({"opening": ["left", "right"]},
                            lambda c: c | {"left": c["gap"] / 2, "right": -c["gap"] / 2},
                            r"left \+ right stays as it is: it counts the other way; expected right = {"),
}  # fmt: skip


def test_the_lines_mend_what_they_refuse(performed):
    """Each line written into rig.toml reads the recording as it was."""
    healthy = read_trial(wrist_recording(performed, PLAIN), wrist_rig(PLAIN))
    for said, change, line in REFUSED.values():
        columns = change(wrist_recording(performed, PLAIN))
        table = wrist_rig(PLAIN, **said).model_dump(exclude_none=True, exclude_defaults=True)
        with pytest.raises(InputError, match=line) as told:
            read_trial(columns, parse_rig(table))
        assert "\n" not in str(told.value)
        entry = tomllib.loads(re.sub(r" under \[\w+\].*", "", str(told.value).split("; expected ")[1]))
        if "under [gripper]" in str(told.value):
            table["gripper"] |= entry
        else:
            table["columns"] = entry
        trial = read_trial(columns, parse_rig(table))
        for name in ("fy1", "y1"):
            np.testing.assert_allclose(
                np.abs(trial.channels[name]), np.abs(healthy.channels[name]), atol=0.02
            )
