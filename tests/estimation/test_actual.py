"""Reading actual.toml: what it gives, and every refusal by its message."""

import re

import pytest
from refusals import refused

from estimation.report import compare, disagreements, parse_actual, read_actual

GOOD = {"block1": {"weight": {"unit": "N", "value": 0.343, "sd": 0.0005}}}
FOUND = {"block1": {"weight": {"mean": 0.4639, "sd": 0.0015, "interval_95": [0.461, 0.467]},
                    "width": {"mean": 0.036105, "sd": 1.6e-5, "interval_95": [0.03607, 0.03614]},
                    "height": None, "friction": {"lower_bound": 0.5}}}  # fmt: skip


def test_a_file_gives_values_with_deviations_and_a_missing_one_is_named(tmp_path):
    path = tmp_path / "actual.toml"
    path.write_text(
        '[block1.weight]\nunit = "N"\nvalue = 0.343\nsd = 0.0005\n'
        '[block2.height]\nunit = "m"\nvalue = 1\n[block2.friction]\nunit = "1"\nvalue = 1.2\nsd = 0.1\n'
    )
    assert read_actual(path, ["block1", "block2"]) == {"block1": {"weight": (0.343, 0.0005)},
                                                       "block2": {"height": (1.0, 0.0),
                                                                  "friction": (1.2, 0.1)}}  # fmt: skip
    refused(r"absent\.toml: no such file", read_actual, tmp_path / "absent.toml", ["block1"])


@pytest.mark.parametrize("table, message", [
    *(({"block1": {"weight": entry}}, message) for entry, message in [
        ({"unit": "kg", "value": 1.0}, "key block1.weight.unit: found 'kg'; expected \"N\""),
        ({"value": 1.0}, "key block1.weight.unit: found None"),
        ({"unit": "N"}, "key block1.weight.value: found None; expected a number > 0"),
        ({"unit": "N", "value": 0.0}, "key block1.weight.value: found 0.0; expected a number > 0"),
        ({"unit": "N", "value": True}, "key block1.weight.value: found True"),
        ({"unit": "N", "value": float("nan")}, "key block1.weight.value: found nan"),
        ({"unit": "N", "value": 1.0, "sd": -0.1}, "key block1.weight.sd: found -0.1; expected a number >= 0"),
        ({"unit": "N", "value": 1.0, "sdd": 0.1}, "key block1.weight.sdd: unknown key; expected one of sd, "),
        (0.3, "key block1.weight: found 0.3; expected a table with unit, value and sd"),
    ]),
    ({"blok1": GOOD["block1"]}, "key blok1: is not an object of the task; expected one of block1, block2 "
                                "(did you mean block1?)"),
    ({"block1": {"wieght": {}}}, "key block1.wieght: unknown property; expected one of friction, height, "
                                 "weight, width (did you mean weight?)"),
    ({"block1": 3}, "key block1: found 3; expected tables [block1.PROPERTY]")])  # fmt: skip
def test_refused_entries_and_tables(table, message):
    refused(re.escape(message), parse_actual, table, ["block1", "block2"])


def test_what_the_recordings_contradict_is_remarked_on():
    measured = {"block1": {"weight": (0.5126, 0.0005), "width": (0.0361, 1e-4), "height": (0.026, 1e-4)}}
    compared = compare(FOUND, measured)
    assert compared["block1"]["weight"]["disagrees"] and not compared["block1"]["width"]["disagrees"]
    assert compared["block1"]["height"] == {"value": 0.026, "sd": 1e-4}
    (line,) = disagreements(FOUND, compared)
    assert line.startswith("block1.weight: the recordings say 0.4639 ± 0.0015 N, 9.5 % below")
    assert not compare(FOUND, measured, smallest=0.2)["block1"]["weight"]["disagrees"]  # [tolerance] property
    compared = compare(FOUND, {"block1": {"friction": (0.3, 0.02)}})
    assert disagreements(FOUND, compared)[0].startswith("block1.friction: measured as 0.300 ± 0.020, but")
    assert disagreements(FOUND, compare(FOUND, {"block1": {"friction": (0.45, 0.02)}})) == []
