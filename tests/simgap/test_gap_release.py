"""What is seen while pads close or let go, or a block comes off its support, is no evidence of an effect."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from simgap.gap.residuals import HELD, LOOSE, _firm
from simgap.gap.sensor_noise import MISFIT, STARTING, misfit

MOVES = np.repeat(np.eye(2)[None, [0] * 10 + [1] * 10], 1, axis=0)  # (1, 20, 2)


def grips(first: list[float]) -> np.ndarray:
    """Firmness (20,): one grip begins with the given ones and is 2 N, the other is 0.5 N."""
    grip = jnp.asarray([[*first, *[2.0] * (10 - len(first)), *[0.5] * 10]])
    return np.asarray(_firm(grip, jnp.ones_like(grip), jnp.asarray(MOVES)))[0]


@pytest.mark.parametrize(("grip", "holds"), [(0.3, False), (0.05, False), (1.6, True)])
def test_a_grip_is_firm_by_what_it_usually_is(grip, holds):
    firm = grips([grip])
    assert firm[0] > 0.95 if holds else firm[0] < 0.05
    assert firm[5] > 0.95


def test_a_light_grip_is_firm_where_it_is_usual():
    assert (grips([])[10:] > 0.95).all()


def test_nothing_is_held_by_less_than_noise():
    grip = jnp.full((1, 20), 0.5 * HELD)
    assert (np.asarray(_firm(grip, jnp.ones_like(grip), jnp.asarray(MOVES))) < 0.1).all() and 0 < LOOSE < 1


def test_how_fast_a_block_comes_off_its_support_is_in_doubt():
    t = np.arange(12) * 0.05
    force = np.zeros((12, 4))
    force[6:, 1] = 0.8  # N; the weight comes onto one finger within a sample
    free, starting = np.zeros(12, bool), t == t[6]
    doubt = misfit(t, force, free, starting, np.array([t[6]]))
    assert doubt[6, 1] == pytest.approx(STARTING * 0.8)
    assert doubt[5, 1] == pytest.approx(MISFIT * 0.8) and doubt[0, 1] == 0
