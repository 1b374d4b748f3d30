import jax
import numpy as np
import pytest

from hmmseg.errors import InputError
from hmmseg.hand.kinematics import forward, inverse, joint_velocity, require_reach, tip_velocity
from hmmseg.io.rig import Finger

FINGERS = {1: Finger(base=(0.05, 0.17), links=(0.12, 0.10)), 2: Finger(base=(0.21, 0.17), links=(0.12, 0.12))}
RNG = np.random.default_rng(0)
TIPS = np.stack([RNG.uniform(0.08, 0.17, 50), RNG.uniform(0.005, 0.08, 50)], -1)


@pytest.mark.parametrize("number", [1, 2])
def test_inverse_undoes_forward(number):
    q = inverse(FINGERS[number], number, TIPS)
    np.testing.assert_allclose(forward(FINGERS[number], q), TIPS, atol=1e-14)


def test_angles_of_a_known_pose():
    # Both links at right angles: link 1 straight down, link 2 level, as drawn by hand.
    q = inverse(FINGERS[1], 1, np.array([0.05 + 0.10, 0.17 - 0.12]))
    np.testing.assert_allclose(q, [-np.pi / 2, 0.0], atol=1e-12)
    q = inverse(FINGERS[2], 2, np.array([0.21 - 0.12, 0.17 - 0.12]))
    np.testing.assert_allclose(q, [-np.pi / 2, -np.pi], atol=1e-12)


@pytest.mark.parametrize("number", [1, 2])
def test_velocities_agree_with_differences_and_with_jax(number):
    finger, speed, h = FINGERS[number], RNG.uniform(-0.2, 0.2, TIPS.shape), 1e-6
    q = inverse(finger, number, TIPS)
    rate = joint_velocity(finger, q, speed)
    by_difference = inverse(finger, number, TIPS + h * speed) - inverse(finger, number, TIPS - h * speed)
    np.testing.assert_allclose(rate, by_difference / (2 * h), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(tip_velocity(finger, q, rate), speed, atol=1e-13)
    _, by_jax = jax.jvp(lambda z: forward(finger, z), (jax.numpy.asarray(q),), (jax.numpy.asarray(rate),))
    np.testing.assert_allclose(by_jax, speed, atol=1e-13)


def test_a_tip_out_of_reach_is_refused():
    with pytest.raises(InputError, match=r"finger 1: the task needs a tip 0\.5\d+ m from its base"):
        require_reach(FINGERS[1], 1, np.array([[0.6, 0.17]]))
    require_reach(FINGERS[1], 1, TIPS)
