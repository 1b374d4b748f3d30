"""Contacts that are soft at first: a planted toe is found, and none is made of straight contacts."""

import numpy as np
import pytest

from hmmseg.segmentation.stretches import NONE, Toe, find

SD = 2e-5


def releases(toe=NONE, number=8, compliances=(1e-4,), seed=0):
    """Loads from 10 N to none of grips that let go, and the fingers' distance."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(number):
        load = np.r_[np.full(8, 10.0), np.linspace(10, rng.uniform(0.1, 0.6), 9)]
        give = compliances[k % len(compliances)] * load + toe.give(load)
        out.append((load, rng.uniform(0.02, 0.05) - give + SD * rng.standard_normal(load.size), SD))
    return out


@pytest.mark.parametrize("planted", [Toe(6e-4, 0.8), Toe(3e-4, 1.6)])
def test_a_planted_toe_is_found(planted):
    found = find(releases(planted))
    at = np.array([0.0, 0.2, 1.0, 4.0])
    np.testing.assert_allclose(found.give(at), planted.give(at), atol=6e-5)
    assert found.slope == pytest.approx(planted.slope, rel=0.3)


@pytest.mark.parametrize("compliances", [(1e-4,), (1e-4, 2e-4)])
def test_straight_contacts_have_none_however_they_differ(compliances):
    assert all(find(releases(compliances=compliances, seed=seed)) is NONE for seed in range(10))


def test_a_contact_that_stiffens_the_other_way_has_none():
    assert find(releases(Toe(-4e-4, 0.8))) is NONE


def test_too_few_samples_show_nothing():
    assert find([]) is NONE and find([(np.ones(3), np.ones(3), SD)]) is NONE
