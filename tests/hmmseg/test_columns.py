"""Columns of other labs: the mapping against values planted in SI, and every mapping refused."""

import numpy as np
import pandas as pd
import polars as pl
import pytest

from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import parse_rig
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import CARTESIAN_CHANNELS
from hmmseg.io.units import UNITS, known_unit, measures, si_factor, unit_in_name

PLAIN = SequenceTask(("a", "b"))


def scene(samples: int = 40) -> dict[str, np.ndarray]:
    """A Cartesian hand's channels in SI."""
    rng = np.random.default_rng(3)
    columns = {name: rng.uniform(-0.1, 0.1, samples) for name in CARTESIAN_CHANNELS}
    columns["x2"] = columns["x2"] + 0.3
    return {"t": np.arange(samples) * 0.02, **columns}


THEIRS = {
    "t": ("stamp", "ns", 1, 0.0), "x1": ("left x [mm]", "mm", -1, 0.25), "y1": ("ly", "cm", 1, 0.0),
    "vx1": ("lvx", 1e-3, -1, 0.0), "fx1": ("lfx", "mN", -1, 0.1), "fy2": ("rfy", "kgf", 1, -0.5),
}  # fmt: skip


def test_mapping_is_undone_by_units_sign_and_offset():
    ours = scene()
    theirs = dict(ours)
    for name, (source, unit, sign, offset) in THEIRS.items():
        theirs[source] = (
            (theirs.pop(name) - offset) * sign / (si_factor(unit) if isinstance(unit, str) else unit)
        )
    theirs["name alone"] = theirs.pop("y2")
    rig = parse_rig({"columns": {
        name: {"from": source, "unit": unit, "sign": sign, "offset": offset}
        for name, (source, unit, sign, offset) in THEIRS.items()
    } | {"y2": "name alone"}})  # fmt: skip
    trial = read_trial(theirs, rig)
    np.testing.assert_allclose(trial.t, ours["t"], atol=1e-12)
    for name in CARTESIAN_CHANNELS:
        np.testing.assert_allclose(trial.channels[name], ours[name], atol=1e-12, err_msg=name)


@pytest.mark.parametrize("make", [dict, pd.DataFrame, pl.DataFrame], ids=["dict", "pandas", "polars"])
def test_tables_in_memory_are_the_same_trial(make):
    ours = scene()
    trial = read_trial(make(ours), parse_rig({}))
    for name in CARTESIAN_CHANNELS:
        np.testing.assert_array_equal(trial.channels[name], ours[name])


def test_polars_nulls_are_missing():
    ours = scene()
    frame = pl.DataFrame(ours).with_columns(
        pl.when(pl.arange(pl.len()) == 3).then(None).otherwise(pl.col("fx1")).alias("fx1")
    )
    assert np.flatnonzero(np.isnan(read_trial(frame, parse_rig({})).channels["fx1"])).tolist() == [3]


def test_a_plain_task_takes_mapped_and_own_names():
    table = {"stamp": np.arange(10) * 20.0, "F": np.arange(10.0), "other": np.ones(10)}
    rig = parse_rig({"columns": {"t": {"from": "stamp", "unit": "ms"}, "force": {"from": "F", "unit": "mN"}}})
    trial = read_trial(table, rig, PLAIN)
    assert sorted(trial.channels) == ["force", "other"]
    assert trial.rate == pytest.approx(50.0)
    np.testing.assert_allclose(trial.channels["force"], np.arange(10) * 1e-3)


def test_dates_become_seconds_since_the_first():
    ours = scene(10)
    stamps = np.datetime64("2026-11-23T15:00:00.5", "ns") + (ours["t"] * 1e9).astype("timedelta64[ns]")
    for t in (
        stamps,
        np.array([f"{s}Z" for s in stamps], dtype=object),
        pd.Series(stamps).dt.tz_localize("CET"),
    ):
        trial = read_trial({**ours, "t": t}, parse_rig({}))
        np.testing.assert_allclose(trial.t, ours["t"], atol=1e-12)
        assert trial.origin is not None
    assert read_trial({**ours, "t": stamps}, parse_rig({})).origin == stamps[0].astype(int)


def test_mappings_that_do_not_fit_the_file():
    ours = scene()
    with pytest.raises(InputError, match=r"column left: missing, but the rig maps x1 to it; expected one of"):
        read_trial(ours, parse_rig({"columns": {"x1": "left"}}))
    with pytest.raises(InputError, match=r"\[columns\] xl: is no channel of this hand or task; .*mean"):
        read_trial(ours, parse_rig({"columns": {"xl": "x1"}}))


def test_gripper_tolerance_and_mapping_stand_in_the_rig():
    rig = parse_rig({
        "tolerance": {"position": 1e-3, "force": 0.05},
        "gripper": {"opening": "width", "wrench": ["Fx", "Fy", "Fz", "Tx", "Ty", "Tz"], "tool_mass": 0.5,
                    "centre_of_mass": [0, 0, 0.05]},
    })  # fmt: skip
    assert rig.tolerance.position == 1e-3
    assert rig.tolerance.property is None
    assert rig.gripper is not None
    assert rig.gripper.channels == ("x", "y", "z", "width", "Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
    columns = {name: np.linspace(0, 1, 9) for name in ("t", *rig.gripper.channels)}
    with pytest.raises(InputError, match="Fx, Fy, Fz: show no free motion"):
        read_trial(columns, rig)


def test_units():
    assert si_factor("mm") == 1e-3
    assert known_unit("Milliseconds") == "ms"
    assert known_unit("N m") == "Nm"
    assert known_unit("parsec") is None
    for name in UNITS:
        assert known_unit(name) == name
    assert [measures(c) for c in ("t", "x1", "vy2", "fx1", "q12", "dq21", "force")] == [
        "time", "length", "velocity", "force", "angle", "angular velocity", None]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "unit"),
    [("left_x_mm", "mm"), ("force [N]", "N"), ("t (ms)", "ms"), ("angle [°]", "deg"), ("time_ns", "ns"),
     ("x1", None), ("speed_mm/s", "mm/s"), ("finger_left", None), ("state[3]", None)],
)  # fmt: skip
def test_unit_in_a_name(name, unit):
    assert unit_in_name(name) == unit
