"""Draws mixed of a design that believes the rig's pads and of one that doubts them."""

from dataclasses import replace

import numpy as np
import pytest

from estimation.design import PadDoubt
from estimation.sampler import Draws, mixed

PROPS = ("weight", "width", "height")


def draws(value: float) -> Draws:
    empty = np.zeros((4, 500, 0))
    return Draws(empty, np.full((4, 500, 3), value), empty, empty, 1e4, 1.0, 0.5, 500, 1.0)


@pytest.mark.parametrize("doubted", [False, True])
def test_each_property_is_drawn_with_the_odds_of_its_own_pads(doubted):
    doubt = PadDoubt(odds=(0.2, 0.995), doubted=doubted)
    likelier, other = (draws(float(v)) for v in ((1, 0) if doubted else (0, 1)))  # 1 where pads are wrong
    weight, width, height = mixed(likelier, other, PROPS, doubt, 0).flat.mean(axis=0)
    assert weight == float(doubted)  # no pad enters
    assert width == pytest.approx(0.2, abs=0.03)
    assert height == 1.0


def test_without_odds_the_rig_is_believed():
    doubt = PadDoubt(odds=(0.6, 0.0), doubted=True)
    _, width, height = mixed(draws(1.0), draws(0.0), PROPS, doubt, 0).flat.mean(axis=0)
    assert width == pytest.approx(0.6, abs=0.04) and height == 0.0
    assert replace(doubt, doubted=False).extra_sd("normal") == 0.0
