"""A finger that pushes down harder than friction could carry stands on something."""

from __future__ import annotations

import numpy as np
import pytest

from hmmseg.hand.read import read_trial
from hmmseg.io.rig import FORCE_CHANNELS, read_rig
from hmmseg.io.task import read_task
from hmmseg.segmentation.align import align
from hmmseg.segmentation.free_contacts import astride, standing

T = np.arange(0.0, 4.0, 0.02)
GRIPPED = T > 2.0


def make(fy1: np.ndarray, grip: float = 3.0) -> np.ndarray:
    """Stretches found where finger 1 pushes with `fy1` and both grip from 2 s on."""
    values = {name: np.zeros_like(T) for name in FORCE_CHANNELS}
    values |= {"fx1": grip * GRIPPED, "fx2": -grip * GRIPPED, "fy1": fy1}
    force = np.stack([values[name] for name in FORCE_CHANNELS], axis=1)
    return standing(T, force, 0.02, ~GRIPPED & (T < 1.0))


def test_a_push_within_friction_is_none():
    assert not make(-2.0 * GRIPPED).any()


def test_a_push_beyond_friction_is_told_with_its_moment():
    pushed = (T >= 1.5) & (T < 2.5)
    found = make(-6.0 * pushed)
    np.testing.assert_array_equal(found, pushed)


def test_an_impact_and_an_offset_are_none():
    assert not make(np.where(np.abs(T - 1.5) < 0.03, -6.0, 0.0)).any()
    assert not make(np.full_like(T, -0.8)).any()


def closing(wide: np.ndarray, pressed: np.ndarray, other: np.ndarray | None = None):
    """What fingers `wide` [m] apart meet before 2 s; both press where `pressed`, or one and `other`."""
    press = 2.0 * np.stack([pressed, pressed if other is None else other], axis=1)
    return astride(T, press, wide, 0.02, 0.02, 2.0)


def test_something_wider_between_closing_fingers_is_told_with_moment_and_width():
    wide = np.where(T < 1.99, 0.025, 0.02)
    since = T > 1.87
    assert closing(wide, since) == pytest.approx((1.88, 0.025))
    # After a pause no longer than an impact it is one closing; what lies further back is another.
    assert closing(wide, since & (np.abs(T - 1.94) > 0.01)) == pytest.approx((1.88, 0.025))
    assert closing(wide, since & (np.abs(T - 1.94) > 0.03)) == pytest.approx((1.98, 0.025))
    assert closing(wide, (T > 1.0) & (T < 1.9)) is None


def test_a_finger_that_comes_first_and_pushes_the_block_has_nothing_else():
    assert closing(np.where(T < 1.99, 0.03, 0.02), T > 1.8, T > 1.99) is None
    assert closing(np.full_like(T, 0.021), T > 1.8) is None


def test_fingers_pressed_on_the_table_are_told(shared):
    folder = shared / "panda" / "pick_low_5"
    if not folder.exists():
        pytest.skip("../shared/panda is absent")
    rig, task = read_rig(folder / "rig.toml"), read_task(folder / "task.toml")
    found = align([read_trial(folder / "trial_01.csv", rig)], task, rig).segmentations[0]
    assert found.failed is not None
    assert "a finger pushed down on something at 1.8" in found.failed.reason
