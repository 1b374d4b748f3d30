"""Blocks that slide in the pads as they are set down: their places count for less, others for as much."""

from dataclasses import replace

import numpy as np
import pytest

from estimation.observations import Noise, WeighedTrial, Weights, with_slides
from estimation.pads import landing
from hmmseg.hand.signals import Signals
from hmmseg.io.rig import Fingertip, Rig, Systematic

from .test_landing import STIFFNESS, TOUCH, landed, place_of

NOISE = Noise({"place": 1e-10}, {"place": 100.0})
RIG = Rig.model_validate(
    {"rate": 100.0, "noise": {}, "fingertip": {"normal_stiffness": 4000.0, "shear_stiffness": STIFFNESS / 2}}
)


def trial(seed=0, count=50.0, **others):
    """A trial of one grip, whose block is set down on pads as in `landed`."""
    t, reading, give, net = landed(noise=1e-5, seed=seed, **others)
    found = landing(t, reading, give, place_of(t), (TOUCH, 1e-4), t < TOUCH, 1e-5)
    assert found is not None
    still = dict.fromkeys(
        ("x1", "vx1", "vy1", "fx1", "x2", "vx2", "vy2", "fx2", "sd_x", "sd_y", "sd_vx", "sd_vy"), 0 * t
    )
    y = reading - give  # so that block_y is the reading
    signals = Signals(t=t, y1=y, y2=y, fy1=net / 2, fy2=net / 2, sd_force=0.01, **still)
    weights = Weights(
        {0: {"place": place_of(t)[None]}}, {0: {"place": np.array([count])}}, 0 * t, np.zeros((4, t.size)),
        0.0, {0: {"landing": found}},
    )  # fmt: skip
    return WeighedTrial(signals, np.ones((1, 1, t.size), bool), weights)


def uncertain(a):
    """Standard deviation of the place's mean [m], and whether its landing is a witness."""
    count = float(a.weights.counts[0]["place"][0])
    return np.sqrt(NOISE.variance["place"] / count), "landing" in a.weights.slopes[0]


def test_a_block_that_slid_is_as_uncertain_as_it_slid():
    own = [trial(seed=k) for k in range(3)] + [trial(seed=3, creep=6e-4)]
    *kept, slid = map(uncertain, with_slides(own, NOISE, RIG))
    assert all(sd == pytest.approx(np.sqrt(1e-10 / 50)) and witness for sd, witness in kept)
    assert slid[0] == pytest.approx(6e-4, rel=0.15) and not slid[1]


def test_one_trial_alone_is_judged_by_what_the_rig_says_of_its_pads():
    (slid,) = map(uncertain, with_slides([trial(creep=6e-4)], NOISE, RIG))
    assert slid[0] == pytest.approx(6e-4, rel=0.15)
    unsure = RIG.model_copy(update={"systematic": Systematic(pad_stiffness=(0.3, 0.3))})
    (softer,) = map(uncertain, with_slides([trial(share=0.2)], NOISE, unsure))
    assert softer == (pytest.approx(np.sqrt(1e-10 / 50)), True)


def test_pads_softer_than_stated_are_no_slide_where_all_grips_say_so():
    own = [trial(seed=k, share=0.8) for k in range(4)]
    assert all(witness for _, witness in map(uncertain, with_slides(own, NOISE, RIG)))


def test_pads_that_nobody_measured_may_give():
    rig = RIG.model_copy(update={"fingertip": Fingertip(normal_stiffness=np.inf, shear_stiffness=np.inf)})
    a = trial()
    none = replace(a, weights=replace(a.weights, slopes={0: {}}))
    assert with_slides([none], NOISE, rig) == [none]
