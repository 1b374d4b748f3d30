"""Which interval a contact switched in: against quadrature, and what outvotes what."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from hmmseg.segmentation.changes import Penetration, log_contact, switch_probability


def sensed(p, sd_pressed=3e-6, sd_place=3e-5, seed=0, **others):
    """A contact of known penetration, with noise."""
    rng = np.random.default_rng(seed)
    pressed = np.maximum(p, 0) + sd_pressed * rng.standard_normal(p.size)
    place = p + sd_place * rng.standard_normal(p.size)
    rate = np.gradient(p, 0.05)
    made = {"pressed": pressed, "place": place} | others
    return Penetration(np.arange(p.size) * 0.05, made["pressed"], made["place"], rate, sd_pressed,
                       sd_pressed, sd_place, 3e-3, 0.0)  # fmt: skip


APPROACH = np.linspace(-1.17e-3, 0.93e-3, 22)


@pytest.mark.parametrize("pressed, place", [(4e-5, 2e-5), (1e-6, -5e-5), (0.0, 2e-5)])
def test_weights_of_contact_are_integrals_over_the_penetration(pressed, place):
    # With Gaussian tails near the mode: Student-t residuals agree to a factor that both sides share.
    c = sensed(np.array([place, 3e-4]), pressed=np.array([pressed, 3e-4]), place=np.array([place, 3e-4]))
    contact, none = log_contact(c, making=True)

    def joint(p):
        return norm.pdf(place, p, c.sd_place) * norm.pdf(pressed, p, c.sd_pressed)

    held = quad(joint, 0, 3e-4, points=[pressed])[0]
    apart = norm.pdf(pressed, 0, c.sd_pressed) * norm.cdf(-place / c.sd_place)
    if abs(pressed - place) < 2 * c.sd_place:
        assert contact[0] - none[0] == pytest.approx(np.log(held / apart), abs=1.0) or held / apart > 1e3


@pytest.mark.parametrize("making", [True, False])
def test_the_interval_of_the_sign_change_is_found(making):
    p = APPROACH if making else APPROACH[::-1]
    probability = switch_probability(sensed(p), np.zeros(p.size - 1), making)
    n = int(np.flatnonzero(np.diff(np.sign(p)))[0])
    assert probability[n] > 0.9 and probability.sum() == pytest.approx(1.0)


def test_a_missing_sensor_adds_nothing_and_the_other_decides():
    for lost in ("pressed", "place"):
        c = sensed(APPROACH, **{lost: np.full(APPROACH.size, np.nan)})
        probability = switch_probability(c, np.zeros(APPROACH.size - 1), True)
        n = int(np.flatnonzero(np.diff(np.sign(APPROACH)))[0])
        assert probability[n - 1 : n + 2].sum() > 0.9


def test_a_ringing_force_after_a_release_is_no_contact():
    p = APPROACH[::-1]
    ringing = np.where(p < -2e-4, 1e-4 * np.sin(np.arange(p.size)), np.maximum(p, 0))
    probability = switch_probability(sensed(p, pressed=ringing), np.zeros(p.size - 1), False)
    n = int(np.flatnonzero(np.diff(np.sign(p)))[0])
    assert probability[n - 1 : n + 2].sum() > 0.9


def test_places_lost_in_noise_do_not_date_a_lift_early():
    """A load that fades slowly, then a hand that leaves; places are four times as noisy as it is deep."""
    p = np.concatenate([np.linspace(1e-4, 0, 12)[:-1], -(np.linspace(0.0, 1.3e-1, 14) ** 3)])
    ranks, true = [], 10
    for seed in range(80):
        c = sensed(p, sd_pressed=3e-5, sd_place=4e-4, seed=seed)
        probability = switch_probability(c, np.zeros(p.size - 1), False)
        ranks.append(probability[:true].sum() + probability[true] / 2)
    assert 0.2 < np.mean(ranks) < 0.8  # places weighed as surely as forces had made it 0.998
    assert np.mean((np.array(ranks) > 0.05) & (np.array(ranks) < 0.95)) > 0.65


def test_a_finger_that_pushes_the_block_on_touched_when_its_force_says_so():
    place = APPROACH - 6e-4  # the face as it lies later, where the other finger stopped it
    probability = switch_probability(sensed(APPROACH, place=place), np.zeros(APPROACH.size - 1), True)
    n = int(np.flatnonzero(np.diff(np.sign(APPROACH)))[0])
    assert probability[n - 1 : n + 2].sum() > 0.8
