"""A number printed with confidence is no nonsense: recordings altered as sensors and rigs go wrong."""

import re
import tomllib

import numpy as np
import pandas as pd
import pytest
from fault_scene import FOLDER
from scipy.stats import norm

from estimation import identify
from estimation.consistency import SIZE, WELL_MADE, WRONG, Tie
from hmmseg.hand.read import read_trial
from hmmseg.hand.sensing import remove_faults
from hmmseg.io.formats import read_table
from hmmseg.io.rig import read_rig
from hmmseg.io.trial import trial_of
from simgap import simulate

FORCES = ("fx1", "fy1", "fx2", "fy2")
RATES = ("dq11", "dq12", "dq21", "dq22")
PROPERTIES = ("weight", "width", "height")
TRUTH = {  # recordings/labels.json
    "block1": {"weight": 0.57789, "width": 0.018795, "height": 0.017266},
    "block2": {"weight": 0.52560, "width": 0.027978, "height": 0.012562},
}
TABLE = {name: v.to_numpy(float) for name, v in pd.read_csv(FOLDER / "trial_01.csv").items()}


PLACE = np.arange(TABLE["t"].size)
NAMES = [name for name in TABLE if name != "t"]
QUICK = ("frozen force", "constant", "frozen encoder", "wild cell", "saturated", "drifting zero", "twice",
         "one finger", "one vertical", "clock")  # fmt: skip


def at(share):
    return int(share * PLACE.size)


def frozen(*names, start=0.55, stop=1.0, value=None):
    there = (at(start) <= PLACE) & (at(stop) > PLACE)
    return lambda c: {n: np.where(there, c[n][at(start)] if value is None else value, c[n]) for n in names}


def scaled(factor, *names):
    return lambda c: {n: c[n] * factor for n in names}


def cell(name, share, value):
    return lambda c: {name: np.where(at(share) == PLACE, value, c[name])}


def clipped(most, *names):
    return lambda c: {n: np.clip(c[n], -most, most) for n in names}


def later(share, size, name="t"):
    return lambda c: {name: c[name] + size * (at(share) <= PLACE)}


def lacking(share):
    """Every channel lacks each so many-th of its readings, one after the other."""
    return lambda c: {n: np.where(k % share == PLACE % share, np.nan, c[n]) for k, n in enumerate(NAMES)}


ALTERED = {
    "frozen force": (frozen("fx1"), "fx1 repeats -0.00762 .* from 5.50 to 9.95 s"),
    "frozen in a grip": (frozen("fx1", start=0.3), "fx1 repeats 2.49"),
    "both fingers": (frozen("fx1", "fx2"), "fx2 repeats"),
    "a while": (frozen("fy2", start=0.35, stop=0.45), "fy2 repeats .* from 3.50 to 4.45 s"),
    "dead at zero": (frozen("fx1", value=0.0), "fx1 repeats 0 "),
    "constant": (frozen("fy1", start=0.0), "fy1 reads 0.00.* in every row"),
    "frozen encoder": (frozen("q11"), "q11 repeats"),
    "frozen joint": (frozen("q22", "dq22"), "q22 repeats"),
    "no velocities": (frozen(*RATES, start=0.0, value=0.0), "dq11, dq12, dq21, dq22 stand still"),
    "wild cell": (cell("fx1", 0.5, 1e9), "fx1 reads 1e.09"),
    "wild angle": (cell("q21", 0.3, 1e6), "q21 (reads 1e.06|jumps by)"),
    "saturated": (clipped(2.0, *FORCES), "fx1 goes no farther than 2: it saturates"),
    "lost counts": (later(0.7, 0.2, "q21"), "q21 jumps by 0.19.* at 7.00 s"),
    "moved zero": (later(0.5, 1.0, "fx2"), "the zero of fx2 moves"),
    "drifting zero": (lambda c: {"fy1": c["fy1"] + 0.01 * c["t"]}, "the zero of fy1 drifts by 0.01 N/s"),
    "twice": (scaled(2.0, *FORCES), "forces are read 1.8 times too large"),
    "ten times": (scaled(10.0, *FORCES), "forces are read 8.* times too large"),
    "half": (scaled(0.5, *FORCES), "forces are read 2 times too small"),
    "one finger": (scaled(2.0, "fx2", "fy2"), "fx1 and -fx2 press what is carried"),
    "one vertical": (scaled(2.0, "fy1"), "what fy1 takes of a carried weight fy2 gives up 0.5.*-fold"),
    "angles": (scaled(1.1, "q11", "q12", "q21", "q22"), "distance changes by 2. cm a metre .* vertically"),
    "one angle": (later(0.0, 0.05, "q11"), "distance changes by 1.* cm a metre"),
    "velocities": (scaled(2.0, *RATES), "0.5.* times as far as their velocities"),
    "every other row": (lambda c: {n: np.where(PLACE % 2, c[n], np.nan) for n in NAMES},
                         "every channel lacks 50% of its readings"),
    "holes": (lacking(len(NAMES)), "every row without some reading"),
    "clock": (later(0.5, 1.0), "t jumps by 1.05 s at 4.95 s")}  # fmt: skip


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow)
                                  for n in ALTERED])  # fmt: skip
def test_what_a_sensor_cannot_have_read_is_named_and_no_number_hangs_on_it(name):
    alter, named = ALTERED[name]
    assert_no_number_misleads(identify(TABLE | alter(TABLE), FOLDER / "task.toml", FOLDER / "rig.toml"),
                              named)  # fmt: skip


def assert_no_number_misleads(found, named):
    said = [*found.aligned.trials[0].trial.warnings, *found.warnings]
    assert any(re.search(named, line) for line in said), said
    for obj, props in TRUTH.items():
        for prop in PROPERTIES:
            if (obj, prop) in found.names:
                low, high = np.quantile(found.of(obj, prop), [5e-4, 1 - 5e-4])
                assert low <= props[prop] <= high, (obj, prop, low, high)
            else:
                assert found.reasons[f"{obj}.{prop}"]


def test_coarse_forces_and_hands_that_stand_closer_say_no_more_than_they_can():
    rounded = {name: 0.25 * np.round(TABLE[name] / 0.25) for name in FORCES}
    found = identify(TABLE | rounded, FOLDER / "task.toml", FOLDER / "rig.toml")
    for obj, props in TRUTH.items():
        low, high = np.quantile(found.of(obj, "weight"), [0.01, 0.99])
        assert low <= props["weight"] <= high, (obj, low, high)
    rig = tomllib.loads((FOLDER / "rig.toml").read_text())
    hand(wider=-0.01)(rig)
    found = identify(TABLE, FOLDER / "task.toml", rig)
    assert found.of("block1", "width").mean() == pytest.approx(TRUTH["block1"]["width"] - 0.01, abs=1e-4)
    assert any("bases that stand closer than it says would not show" in note for note in found.notes)
    hand(wider=-0.04)(rig)  # a width below nothing is none, and the weights stay
    found = identify(TABLE, FOLDER / "task.toml", rig)
    assert "comes out at -0.0312 m" in found.reasons["block1.width"]
    assert found.of("block1", "weight").mean() == pytest.approx(0.578, rel=0.02)


def hand(wider=0.0, higher=0.0, **links):
    def alter(rig):
        for name, finger in rig["fingers"].items():
            finger["links"] = [links.get(f"links{name}", 1.0) * length for length in finger["links"]]
            finger["base"][1] += higher
        rig["fingers"]["2"]["base"][0] += wider

    return alter


RIGS = {"wider by 5 cm": (hand(wider=0.05), "comes 3. mm within a block that stands"),
        "links too long": (hand(links1=1.1, links2=1.1), "is held .* mm beneath its bottom"),
        "links too short": (hand(links1=0.9, links2=0.9), "is held .* mm above its top"),
        "one finger's links": (hand(links1=1.1), "distance changes by 9.5 cm a metre")}  # fmt: skip


@pytest.mark.parametrize("name", RIGS)
def test_a_rig_that_is_no_such_hand_is_named_and_no_number_hangs_on_it(name):
    rig, (alter, named) = tomllib.loads((FOLDER / "rig.toml").read_text()), RIGS[name]
    alter(rig)
    assert_no_number_misleads(identify(TABLE, FOLDER / "task.toml", rig), named)


def test_a_block_put_down_beside_its_support_tells_no_height():
    rig = {"fingertip": {"normal_stiffness": 4000.0, "shear_stiffness": 2500.0},
           "noise": {"position": 2e-5, "velocity": 3e-3, "force": 0.012}}  # fmt: skip
    made = simulate(FOLDER / "task.toml", rig, seed=2)[0]
    trial, (start, end) = made.trial, made.boundaries[5:7]  # while block2 is carried
    aside = 0.1 * np.clip((trial.t - start) / (end - start), 0.0, 1.0)
    table = {"t": trial.t} | {name: values for name, values in trial.channels.items() if name[0] != "v"}
    table |= {name: table[name] + aside for name in ("x1", "x2")}
    found = identify(table, FOLDER / "task.toml", rig)
    assert re.match(r"block2 stands \d+ mm beside block1, on which", found.reasons["block1.height"])
    assert ("block1", "width") in found.names and ("block2", "weight") in found.names
    whole = {"t": trial.t} | {name: values for name, values in trial.channels.items() if name[0] != "v"}
    early = (trial.t > made.boundaries[0]) & (trial.t < made.boundaries[3])  # block1 is moved unseen
    unseen = identify(whole | {"x1": np.where(early, np.nan, whole["x1"])}, FOLDER / "task.toml", rig)
    assert not any("beside" in text for text in unseen.reasons.values())


@pytest.mark.parametrize("kind", ("balance", "room"))
def test_a_tie_is_as_sure_as_bayes_rule_over_its_two_hypotheses_makes_it(kind):
    value, error = 3.0 * WELL_MADE[kind], 0.5 * WELL_MADE[kind]
    sds = np.hypot(error, WELL_MADE[kind]), np.hypot(np.hypot(error, WELL_MADE[kind]), SIZE[kind])
    healthy, wrong = (norm(0, sd).pdf(value) for sd in sds)
    expected = WRONG * wrong / (WRONG * wrong + (1 - WRONG) * healthy)
    assert Tie(kind, value, error, (), "").probability == pytest.approx(expected)


def test_healthy_recordings_erring_clocks_and_recordings_without_noise_show_no_fault():
    for path in sorted(FOLDER.parent.glob("*/trial_*.csv")):
        rig = read_rig(path.parent / "rig.toml")
        assert remove_faults(trial_of(read_table(path), rig, None), rig).faults == ()
    rig = read_rig(FOLDER / "rig.toml")
    jitter = np.random.default_rng(0).normal(0.0, 0.012, (40, TABLE["t"].size))
    for late in jitter:
        table = TABLE | {"t": np.sort(TABLE["t"] + late)}
        assert not any("jumps by" in line for line in read_trial(table, rig).warnings)
    t = TABLE["t"]
    way = np.interp(t, [0.0, 2.0, 4.0, 6.0, 10.0], [0.0, 0.0, 1.0, 1.0, 0.3])
    smooth = {"t": t} | {name: -1.0 + 0.1 * (i + 1) * way
                         for i, name in enumerate(("q11", "q12", "q21", "q22"))}  # fmt: skip
    smooth |= {f"d{name}": np.gradient(values, t) for name, values in smooth.items() if name != "t"}
    smooth |= {name: sign * np.clip(way - 0.5, 0.0, 1.0)
               for name, sign in zip(FORCES, (1, 0.1, -1, 0.1), strict=True)}  # fmt: skip
    assert read_trial(smooth, rig).faults == ()


@pytest.mark.parametrize("step", [0.02, 0.05, 0.2])
def test_coarse_forces_and_forces_held_for_some_samples_are_none(step):
    rig = read_rig(FOLDER / "rig.toml")
    coarse = TABLE | {name: np.round(TABLE[name] / step) * step for name in FORCES}
    held = TABLE | {name: TABLE[name][(np.arange(TABLE["t"].size) // 4) * 4] for name in FORCES}
    silent = TABLE | {name: np.where(np.abs(TABLE[name]) < step, 0.0, TABLE[name]) for name in FORCES}
    for columns in (coarse, held, silent):
        assert read_trial(columns, rig).faults == ()
