"""The virtual model by steps, driven by a recording, its smoothed motions, and a hand that feels it."""

import jax.numpy as jnp
import numpy as np
import pytest
from simgap_scenes import HAND, STACK

from experiments.benchmarks.haptic_loop import PassivityControl, squeeze, stiffest_passive
from hmmseg.contact.decompose import subtasks
from simgap.world.properties import PAPER_BLOCKS
from simgap.world.replay import replay, residual_summary, smooth
from simgap.world.simulate import simulate_trials
from simgap.world.virtual_model import RIGID_PAD, VirtualModel, physics, rollout, standing, substeps_for

STATES = [s.state for s in subtasks(STACK)]


@pytest.fixture(scope="module")
def performed():
    return simulate_trials(STACK, HAND, [PAPER_BLOCKS], [7])[0]


def places(done):
    return {name: float(done.motion.blocks[0, k, 0]) for k, name in enumerate(STACK.objects)}


def test_the_true_motion_replayed_gives_the_true_forces(performed):
    constants = physics(HAND, [PAPER_BLOCKS[name] for name in STACK.objects])
    motion = performed.motion
    again = rollout(constants, standing(constants, STACK, places(performed)), jnp.asarray(motion.position),
                    jnp.asarray(motion.velocity), 1e-3, substeps_for(constants, 1e-3))  # fmt: skip
    assert np.sqrt(np.mean((again.force - motion.force) ** 2)) < 2e-3
    assert abs(again.blocks - motion.blocks).max() < 5e-5


def test_steps_agree_with_the_rollout_and_reset_starts_over(performed):
    model = VirtualModel(HAND, STACK, PAPER_BLOCKS, places(performed))
    span = slice(1500, 2100)  # the first grasp
    position, velocity = performed.motion.position[span], performed.motion.velocity[span]
    forces = np.stack([model.step(p, v, 1e-3) for p, v in zip(position, velocity, strict=True)])
    constants = model.physics
    whole = rollout(constants, standing(constants, STACK, places(performed)), jnp.asarray(position),
                    jnp.asarray(velocity), 1e-3, substeps_for(constants, 1e-3))  # fmt: skip
    np.testing.assert_allclose(forces, whole.force, atol=1e-9)
    assert abs(forces).max() > 1.0
    np.testing.assert_allclose(model.block_positions(), whole.blocks[-1], atol=1e-12)
    model.reset()
    np.testing.assert_array_equal(model.step(position[0], velocity[0], 1e-3), forces[0])


def test_a_step_refuses_what_is_no_motion():
    model = VirtualModel(HAND, STACK, PAPER_BLOCKS, {"block1": 0.12, "block2": 0.12})
    with pytest.raises(ValueError, match="finite"):
        model.step([[np.nan, 0], [0, 0]], np.zeros((2, 2)), 1e-3)
    with pytest.raises(ValueError, match="dt > 0"):
        model.step(np.zeros((2, 2)), np.zeros((2, 2)), 0.0)


def test_rigid_fingertips_get_a_stiff_pad_and_smaller_steps():
    rigid = physics(HAND.model_copy(update={"fingertip": type(HAND.fingertip)()}), [PAPER_BLOCKS["block1"]])
    assert float(rigid.pad_normal[0]) == RIGID_PAD
    assert substeps_for(rigid, 1e-3) > substeps_for(physics(HAND, [PAPER_BLOCKS["block1"]]), 1e-3)


def test_replay_of_a_simulated_trial_leaves_the_sensors_noise(performed):
    result = replay(performed.trial, STACK, HAND, PAPER_BLOCKS, boundaries=performed.boundaries)
    rest = residual_summary(result, performed.boundaries, STATES)
    assert rest["free-motion"] < 1.15 and rest["hold-above-ground"] < 1.5
    end = result.motion.blocks[-1]
    np.testing.assert_allclose(end, performed.motion.blocks[-1], atol=2e-3)


def test_smoothing_keeps_a_parabola_and_averages_a_rest():
    t = np.arange(0, 4, 0.05)
    truth = np.stack([0.1 + 0.02 * t - 0.03 * t**2, np.full(t.size, 0.05)], 1)
    speed = np.stack([0.02 - 0.06 * t, np.zeros(t.size)], 1)
    sd = np.full((t.size, 2), 2e-5)
    exact = smooth(t, truth, speed, sd, 100 * sd)
    np.testing.assert_allclose(exact.position, truth, atol=1e-9)
    np.testing.assert_allclose(exact.at(np.array([1.234]))[0][0],
                               [0.1 + 0.02 * 1.234 - 0.03 * 1.234**2, 0.05], atol=1e-9)  # fmt: skip
    rng = np.random.default_rng(0)
    noise = [scale * rng.standard_normal(sd.shape) for scale in (2e-5, 2e-3)]
    noisy = smooth(t, truth + noise[0], speed + noise[1], sd, 100 * sd)
    assert np.sqrt(np.mean((noisy.position - truth) ** 2)) < 1e-5
    assert 0.5 < np.std((noisy.position - truth) / noisy.sd) < 2.0


def test_smoothing_bridges_missing_samples():
    t = np.arange(0, 2, 0.05)
    truth = np.stack([0.02 * t], 1)
    holes = truth.copy()
    holes[10:13] = np.nan
    speed, sd = np.where(np.isnan(holes), np.nan, 0.02), np.full(truth.shape, 2e-5)
    path = smooth(t, holes, speed, sd, 100 * sd)
    np.testing.assert_allclose(path.position, truth, atol=1e-6)
    assert path.sd[11, 0] > path.sd[5, 0] / 2


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
    assert loose > 5e-3 and wall(stiffness, 2.0, controlled=True, delay=delay)[0] < 1e-9


def test_control_leaves_a_passive_contact_alone():
    control = PassivityControl(1e-3)
    for k in range(100):
        force = np.array([[2000 * 1e-5 * k, 0.0], [0.0, 0.0]])
        np.testing.assert_array_equal(control.render(force, np.array([[1e-5 * k, 0], [0, 0]])), force)
    assert control.energy == pytest.approx(2000 * 1e-10 * sum(k for k in range(99)))


@pytest.mark.parametrize("rate", [1000.0, 4000.0])
def test_the_virtual_block_is_passive_in_a_delayed_loop(rate):
    found = squeeze(rate, 4000.0, 2e-3, controlled=False, seconds=0.4)
    assert found["returned_J"] < 1e-9 and found["speed_left"] < 0.02
