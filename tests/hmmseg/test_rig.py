"""The nominal hand: what is read, and every rig that is refused, with its message."""

import math

import pytest

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig, parse_rig, read_rig

FINGER = {"base": [0.05, 0.17], "links": [0.12, 0.12]}
HAND = {"fingers": {"1": FINGER, "2": {**FINGER, "base": [0.21, 0.17]}}}


def test_what_is_left_out_has_its_default():
    rig = parse_rig({})
    assert rig == Rig()
    assert not rig.jointed
    assert rig.gravity == 9.80665
    assert math.isinf(rig.fingertip.normal_stiffness)
    assert rig.noise.force is None
    with pytest.raises(ValueError, match="a Cartesian hand has no fingers"):
        rig.finger(1)


def test_systematic_uncertainty_by_number_list_or_name():
    rig = parse_rig({"systematic": {"force_bias": 0.01, "force_gain": [0.1, 0.2, 0.3, 0.4],
                                    "joint_offset": {"q12": 0.002}, "pad_stiffness": 1}})  # fmt: skip
    assert rig.systematic.force_bias == (0.01,) * 4
    assert rig.systematic.force_gain == (0.1, 0.2, 0.3, 0.4)
    assert rig.systematic.joint_offset == (0.0, 0.002, 0.0, 0.0)
    assert rig.systematic.pad_stiffness == (1.0, 1.0)
    assert rig.systematic.link_length == (0.0,) * 4


REFUSED = [
    ({"speed": 1}, r"rig: key speed: unknown key; expected one of .*rate.* \(did you mean"),
    ({"noise": {"forse": 1}}, r"rig: key noise.forse: unknown key; .*did you mean force"),
    ({"fingertip": {"stiffness": 1}}, r"rig: key fingertip.stiffness: unknown key; .*normal_stiffness"),
    ({"systematic": {"bias": 1}}, r"rig: key systematic.bias: unknown key; .*did you mean force_bias"),
    (
        {"fingers": {"1": {**FINGER, "length": 1}, "2": FINGER}},
        r"rig: key fingers.1.length: unknown key; .*links",
    ),
    ({"fingers": {"1": FINGER}}, r"rig: fingers must be the two tables \[fingers.1\] and \[fingers.2\]"),
    ({"fingers": {"1": FINGER, "2": {"base": [0, 0]}}}, "rig: key fingers.2.links: missing"),
    ({"fingers": {"1": FINGER, "2": {**FINGER, "links": [0.1]}}}, r"rig: key fingers.2.links.1: missing"),
    (
        {"fingers": {"1": FINGER, "2": {**FINGER, "links": [0.1, -0.1]}}},
        r"rig: key fingers.2.links.1: .*greater than 0 \(found -0.1\)",
    ),
    (
        {"fingers": {"1": FINGER, "2": {**FINGER, "base": [0.1, math.nan]}}},
        r"rig: key fingers.2.base.1: .*finite",
    ),
    ({"rate": 0}, r"rig: key rate: Input should be greater than 0 \(found 0"),
    ({"rate": "20"}, r"rig: key rate: Input should be a valid number \(found '20'\)"),
    ({"rate": True}, r"rig: key rate: Input should be a valid number \(found True\)"),
    ({"rate": math.nan}, r"rig: key rate: .*finite"),
    ({"gravity": math.inf}, r"rig: key gravity: .*finite"),
    ({"fingertip": {"normal_stiffness": math.nan}}, r"rig: key fingertip.normal_stiffness: .*greater than 0"),
    ({"noise": {"force": 0}}, r"rig: key noise.force: .*greater than 0"),
    ({"noise": 0.1}, r"rig: key noise: .*dictionary"),
    ({"systematic": {"force_bias": -0.1}}, r"rig: key systematic.force_bias.0: .*greater than or equal to 0"),
    ({"systematic": {"force_bias": [0.1, 0.1]}}, r"rig: key systematic.force_bias.2: missing"),
    ({"systematic": {"force_bias": [0.1] * 5}}, r"rig: key systematic.force_bias: .*at most 4"),
    (
        {"systematic": {"force_bias": {"fz1": 0.1}}},
        r"rig: key systematic.force_bias: unknown entry fz1; expected one of fx1, .*did you mean f",
    ),
    ({"systematic": {"force_bias": True}}, r"rig: key systematic.force_bias: must be a number"),
    ({"systematic": {"force_bias": 10**400}}, r"rig: key systematic.force_bias: must be at most 1e\+12"),
    ({"noise": {"force": 1e300}}, r"rig: key noise.force: .*less than or equal to"),
    (
        {"columns": {"x1": {"from": "a", "unit": "furlong"}}},
        "rig: key columns.x1.unit: unknown unit 'furlong'",
    ),
    (
        {"columns": {"x1": {"from": "a", "sing": 1}}},
        r"rig: key columns.x1.sing: unknown key; .*did you mean sign\?",
    ),
    ({"columns": {"x1": {"from": "a", "sign": 2}}}, "rig: key columns.x1.sign: found 2; expected 1 or -1"),
    ({"columns": {"x1": {"from": "a", "offset": math.nan}}}, "rig: key columns.x1.offset: .*finite"),
    ({"columns": {"x1": {"from": ""}}}, "rig: key columns.x1.from: .*at least 1 character"),
    ({"columns": {"x1": 3}}, "rig: key columns.x1: "),
    ({"columns": {"x1": {"unit": -1.0}}}, "rig: key columns.x1.unit"),
    ({"columns": {"t": {"unit": "mm"}}}, "rig: key columns: t is a time, but its unit mm is one of length"),
    (
        {"columns": {"fx1": {"unit": "deg"}}},
        "rig: key columns: fx1 is a force, but its unit deg is one of angle",
    ),
    ({"tolerance": {"lenght": 1}}, r"rig: key tolerance.lenght: unknown key; expected one of force, pos"),
    ({"tolerance": {"force": 0}}, "rig: key tolerance.force: .*greater than 0"),
    ({"gripper": {}}, r"rig: a hand has \[fingers\] or is a \[gripper\], not both"),
]
GRIPPERS = [
    ({"frame": "base"}, "key gripper.frame: "),
    ({"wrench": ["fx"]}, "key gripper.wrench: has 1 columns; expected 3 forces"),
    ({"mass": 1}, r"key gripper.mass: unknown key; .*tool_mass\?"),
    ({"sensor_axes": ["x", "y", "-z"]}, ".*gripper.sensor_axes: x, y, -z are no right-handed axes"),
    ({"position": {"x": "a", "y": "b"}}, ".*position has no column for z, the axis that is up"),
    ({"force_per_ampere": 3.0}, ".*force_per_ampere without motor_current"),
    ({"grip_force": 1e308}, "key gripper.grip_force"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("table", "message"),
    [
        *(({**HAND, **table}, message) for table, message in REFUSED),
        *(({"gripper": table}, f"rig: {message}") for table, message in GRIPPERS),
    ],
)
def test_refused_with_its_message(table, message):
    with pytest.raises(InputError, match=f"^{message}") as caught:
        parse_rig(table)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_absent(tmp_path):
    with pytest.raises(InputError, match=r"absent\.toml: no such file; expected a TOML file"):
        read_rig(tmp_path / "absent.toml")
