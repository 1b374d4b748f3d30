"""Recordings of another hand (an arm's two fingers), altered as labs differ: each gets its line."""

import numpy as np
import pytest

from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.io.rig import read_rig
from hmmseg.io.trial import Trial

PLACES, FORCES = ("x1", "x2", "y1", "y2"), ("fx1", "fx2", "fy1", "fy2")
FOLDERS = ("foam_restack_1", "restack_1", "pick_4", "session_9_50hz")


def scaled(names, factor):
    return lambda columns: columns | {name: factor * columns[name] for name in names}


def swapped(columns):
    return columns | {f"{a}{i}": columns[f"{a}{3 - i}"] for a in ("x", "y", "fx", "fy") for i in (1, 2)}


REFUSED = {
    "mm": (scaled(PLACES, 1e3), 'x1 = {from = "x1", unit = "mm"}'),
    "cm": (scaled(PLACES, 1e2), 'x1 = {from = "x1", unit = "cm"}'),
    "ms": (scaled(["t"], 1e3), 't = {from = "t", unit = "ms"}'),
    "ns": (scaled(["t"], 1e9), 't = {from = "t", unit = "ns"}'),
    "swapped": (swapped, 'x1 = {from = "x2"}'),
    "signs of fx": (scaled(["fx1", "fx2"], -1), 'fx1 = {from = "fx1", sign = -1}'),
    "signs of fy": (scaled(["fy1", "fy2"], -1), 'fy1 = {from = "fy1", sign = -1}'),
    "on the finger": (scaled(FORCES, -1), "forces on the finger, not by it"),
    "inward": (scaled(["fx2"], -1), 'fx2 = {from = "fx2", sign = -1}'),
}
WARNED = {
    "since 1970": (lambda c: c | {"t": c["t"] + 1.7e9}, "counts seconds since 1970"),
    "own weight": (lambda c: c | {n: c[n] - 2.5 for n in ("fy1", "fy2")}, "gravity or an offset is still in"),
    "mN": (scaled(FORCES, 1e3), 'unit = "mN"'),
    "kN": (scaled(FORCES, 1e-3), 'unit = "kN"'),
}


@pytest.fixture(params=FOLDERS)
def recording(request, shared):
    folder = shared / "panda" / request.param
    rig = read_rig(folder / "rig.toml")
    trial = Trial.read(folder / "trial_01.csv", rig)
    assert trial.warnings == ()
    return {"t": trial.t, **{n: v for n, v in trial.channels.items() if n[0] != "v"}}, rig


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_refused_with_what_to_write(recording, name):
    (columns, rig), (change, line) = recording, REFUSED[name]
    with pytest.raises(InputError) as told:
        read_trial(change(columns), rig)
    assert line in str(told.value)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("name", WARNED)
def test_what_is_unlikely_is_told(recording, name):
    (columns, rig), (change, line) = recording, WARNED[name]
    warnings = read_trial(change(columns), rig).warnings
    assert any(line in warning for warning in warnings), warnings
    assert np.isfinite(columns["t"]).all()
