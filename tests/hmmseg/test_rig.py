"""The nominal hand: what is read, and every rig that is refused, with its message."""

from __future__ import annotations

import math

import pytest

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig, parse_rig, read_rig

FINGER = {"base": [0.05, 0.17], "links": [0.12, 0.12]}
HAND = {"fingers": {"1": FINGER, "2": {**FINGER, "base": [0.21, 0.17]}}}


def test_reads_the_papers_hand(shared):
    rig = read_rig(shared / "recordings/paper_blocks/rig.toml")
    assert rig.jointed
    assert rig.rate == 20.0
    assert rig.finger(2).base == (0.21, 0.17)
    assert rig.fingertip.normal_stiffness == 4000.0
    assert (rig.noise.angle, rig.noise.velocity, rig.noise.force) == (0.0002, 0.03, 0.012)
    assert rig.systematic.force_bias == (0.0, 0.0, 0.0, 0.0)


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
    ({"fingers": {"1": {**FINGER, "length": 1}, "2": FINGER}},
     r"rig: key fingers.1.length: unknown key; .*links"),
    ({"fingers": {"1": FINGER}}, r"rig: fingers must be the two tables \[fingers.1\] and \[fingers.2\]"),
    ({"fingers": {"1": FINGER, "2": {"base": [0, 0]}}}, "rig: key fingers.2.links: missing"),
    ({"fingers": {"1": FINGER, "2": {**FINGER, "links": [0.1]}}}, r"rig: key fingers.2.links.1: missing"),
    ({"fingers": {"1": FINGER, "2": {**FINGER, "links": [0.1, -0.1]}}},
     r"rig: key fingers.2.links.1: .*greater than 0 \(found -0.1\)"),
    ({"fingers": {"1": FINGER, "2": {**FINGER, "base": [0.1, math.nan]}}},
     r"rig: key fingers.2.base.1: .*finite"),
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
    ({"systematic": {"force_bias": {"fz1": 0.1}}},
     r"rig: key systematic.force_bias: unknown entry fz1; expected one of fx1, .*did you mean f"),
    ({"systematic": {"force_bias": True}}, r"rig: key systematic.force_bias: must be a number"),
]  # fmt: skip


@pytest.mark.parametrize(("table", "message"), REFUSED)
def test_refused_with_its_message(table, message):
    with pytest.raises(InputError, match=f"^{message}") as caught:
        parse_rig({**HAND, **table})
    assert "\n" not in str(caught.value)


def test_a_file_that_is_absent(tmp_path):
    with pytest.raises(InputError, match=r"absent\.toml: no such file; expected a TOML file"):
        read_rig(tmp_path / "absent.toml")


def test_a_number_beyond_all_floats_is_refused():
    with pytest.raises(InputError, match=r"key systematic.force_bias: must be at most 1e\+12"):
        parse_rig({"systematic": {"force_bias": 10**400}})
