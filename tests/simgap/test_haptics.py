import numpy as np
import pytest

from experiments.benchmarks.haptic_loop import squeeze
from simgap.world.virtual_model import PassivityControl, stiffest_passive


def wall(stiffness: float, damping: float, controlled: bool, delay: int = 1) -> tuple[float, float]:
    """A mass thrown at a sampled, delayed spring, its motion between samples in closed form.

    Energy [J] that the spring returned beyond what it took, and the mass's fastest speed over its first.
    """
    period, mass, start = 1e-3, 0.1, 0.2
    control = PassivityControl(period)
    x, v, returned, energy, fastest = -0.001, start, 0.0, 0.0, 0.0
    queue = [0.0] * delay
    for _ in range(3000):
        queue.append(stiffness * max(x, 0.0))
        held = queue.pop(0)
        if controlled:
            held = control.render(np.array([[held, 0.0], [0.0, 0.0]]), np.array([[x, 0.0], [0.0, 0.0]]))[0, 0]
        decay = np.exp(-damping / mass * period)
        end = -held / damping
        step = end * period + (v - end) * mass / damping * (1 - decay)
        energy += held * step
        x, v = x + step, end + (v - end) * decay
        returned, fastest = max(returned, -energy), max(fastest, abs(v))
    return returned, fastest / start


def test_the_sampled_data_limit_bounds_what_a_damped_device_can_swallow():
    limit = stiffest_passive(damping=2.0, period=1e-3, delay=1e-3)
    assert limit == pytest.approx(2.0 / 1.5e-3)
    assert wall(0.95 * limit, 2.0, controlled=False)[1] < 1.0  # the device swallows what is returned
    assert wall(20 * limit, 2.0, controlled=False)[1] > 1.5


@pytest.mark.parametrize("delay", [1, 2])
def test_control_takes_back_what_the_hold_and_the_delay_made(delay):
    stiffness = 20e3
    loose, _ = wall(stiffness, 2.0, controlled=False, delay=delay)
    assert loose > 5e-3
    assert wall(stiffness, 2.0, controlled=True, delay=delay)[0] < 1e-9


def test_control_leaves_a_passive_contact_alone():
    control = PassivityControl(1e-3)
    for k in range(100):
        force = np.array([[2000 * 1e-5 * k, 0.0], [0.0, 0.0]])
        np.testing.assert_array_equal(control.render(force, np.array([[1e-5 * k, 0], [0, 0]])), force)
    assert control.energy == pytest.approx(2000 * 1e-10 * sum(k for k in range(99)))


@pytest.mark.parametrize("rate", [1000.0, 4000.0])
def test_the_virtual_block_is_passive_in_a_delayed_loop(rate):
    found = squeeze(rate, 4000.0, 2e-3, controlled=False, seconds=0.4)
    assert found["returned_J"] < 1e-9
    assert found["speed_left"] < 0.02
