"""The virtual model by steps, driven by a recording or an operator, and felt; simulated trials."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from simgap_scenes import HAND, STACK
from simgap_scenes import HAND as RIG

from experiments.benchmarks.haptic_loop import PassivityControl, squeeze, stiffest_passive
from experiments.worlds import random_properties
from hmmseg.contact.decompose import subtasks
from hmmseg.errors import InputError
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Finger, Noise, Rig
from hmmseg.io.task import GROUND, BlockTask, Move
from simgap.world.operator import OperatorSettings, minimum_jerk
from simgap.world.properties import PAPER_BLOCKS, Block, read_properties
from simgap.world.replay import replay, residual_summary, smooth
from simgap.world.simulate import simulate_trials
from simgap.world.virtual_model import RIGID_PAD, VirtualModel, physics, rollout, standing, substeps_for

STATES = [s.state for s in subtasks(STACK)]
TOWER = BlockTask({"a": "b", "b": "c", "c": GROUND}, (Move("a", GROUND), Move("b", "a"), Move("c", "b")))
SLIDE = BlockTask({"a": GROUND, "b": GROUND}, (Move("a", GROUND, slide=True), Move("b", "a")))


@pytest.fixture(scope="module")
def performed():
    return simulate_trials(STACK, HAND, [PAPER_BLOCKS], [7])[0]


def places(done):
    return {name: float(done.motion.blocks[0, k, 0]) for k, name in enumerate(STACK.objects)}


def test_the_true_motion_gives_the_true_forces_and_a_replay_the_sensors_noise(performed):
    constants = physics(HAND, [PAPER_BLOCKS[name] for name in STACK.objects])
    motion = performed.motion
    again = rollout(constants, standing(constants, STACK, places(performed)), jnp.asarray(motion.position),
                    jnp.asarray(motion.velocity), 1e-3, substeps_for(constants, 1e-3))  # fmt: skip
    assert np.sqrt(np.mean((again.force - motion.force) ** 2)) < 2e-3
    assert abs(again.blocks - motion.blocks).max() < 5e-5
    result = replay(performed.trial, STACK, HAND, PAPER_BLOCKS, boundaries=performed.boundaries)
    rest = residual_summary(result, performed.boundaries, STATES)
    assert rest["free-motion"] < 1.15 and rest["hold-above-ground"] < 1.5
    end = result.motion.blocks[-1]
    np.testing.assert_allclose(end, performed.motion.blocks[-1], atol=2e-3)


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


def test_rigid_fingertips_get_smaller_steps_and_a_step_refuses_what_is_no_motion():
    model = VirtualModel(HAND, STACK, PAPER_BLOCKS, {"block1": 0.12, "block2": 0.12})
    with pytest.raises(ValueError, match="finite"):
        model.step([[np.nan, 0], [0, 0]], np.zeros((2, 2)), 1e-3)
    with pytest.raises(ValueError, match="dt > 0"):
        model.step(np.zeros((2, 2)), np.zeros((2, 2)), 0.0)
    rigid = physics(HAND.model_copy(update={"fingertip": type(HAND.fingertip)()}), [PAPER_BLOCKS["block1"]])
    assert float(rigid.pad_normal[0]) == RIGID_PAD
    assert substeps_for(rigid, 1e-3) > substeps_for(physics(HAND, [PAPER_BLOCKS["block1"]]), 1e-3)


def test_smoothing_keeps_a_parabola_averages_a_rest_and_bridges_missing_samples():
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
        decay, end = np.exp(-damping / mass * period), -held / damping
        step = end * period + (v - end) * mass / damping * (1 - decay)
        energy += held * step
        x, v = x + step, end + (v - end) * decay
        returned, fastest = max(returned, -energy), max(fastest, abs(v))
    return returned, fastest / start


def test_control_bounds_a_damped_device_and_leaves_a_passive_contact_alone():
    limit = stiffest_passive(damping=2.0, period=1e-3, delay=1e-3)
    assert limit == pytest.approx(2.0 / 1.5e-3)
    assert wall(0.95 * limit, 2.0, controlled=False)[1] < 1.0  # the device swallows what is returned
    assert wall(20 * limit, 2.0, controlled=False)[1] > 1.5
    control = PassivityControl(1e-3)
    for k in range(100):
        force = np.array([[2000 * 1e-5 * k, 0.0], [0.0, 0.0]])
        np.testing.assert_array_equal(control.render(force, np.array([[1e-5 * k, 0], [0, 0]])), force)
    assert control.energy == pytest.approx(2000 * 1e-10 * sum(k for k in range(99)))


@pytest.mark.parametrize("delay", [1, 2])
def test_control_takes_back_what_the_hold_and_the_delay_made(delay):
    stiffness = 20e3
    loose, _ = wall(stiffness, 2.0, controlled=False, delay=delay)
    assert loose > 5e-3 and wall(stiffness, 2.0, controlled=True, delay=delay)[0] < 1e-9


@pytest.mark.parametrize("rate", [1000.0, 4000.0])
def test_the_virtual_block_is_passive_in_a_delayed_loop(rate):
    found = squeeze(rate, 4000.0, 2e-3, controlled=False, seconds=0.4)
    assert found["returned_J"] < 1e-9 and found["speed_left"] < 0.02


@pytest.fixture(scope="module")
def stacked():
    return simulate_trials(STACK, RIG, [PAPER_BLOCKS], [3])[0]


def test_a_trial_shows_its_task_its_widths_and_heights_and_the_rig_s_noise(stacked):
    assert stacked.boundaries.shape == (len(subtasks(STACK)) - 1,)
    assert (np.diff(stacked.boundaries) > 0.1).all()
    signals = task_space(stacked.trial, RIG)
    touch, leave, meet, part = stacked.boundaries[:4]
    t, gripped = signals.t, signals.grip > 0.1
    held = (t > touch + 0.06) & (t < part - 0.06)
    assert gripped[held].all() and not gripped[t < touch - 0.01].any()
    carried = (t > leave + 0.1) & (t < meet - 0.1)
    assert np.mean(signals.fy[carried]) == pytest.approx(0.343, abs=0.01)
    assert np.mean(signals.fy[(t > meet + 0.1) & (t < part - 0.1)]) < 0
    signals, b = task_space(stacked.trial, RIG), stacked.boundaries
    carried = (signals.t > b[1] + 0.1) & (signals.t < b[2] - 0.1)
    grip = np.mean(signals.grip[carried])
    assert np.mean(signals.distance[carried]) == pytest.approx(0.0159 - 2 * grip / 4000, abs=3e-5)
    final = stacked.motion.blocks[-1]
    assert final[0, 1] == pytest.approx(0.016 / 2, abs=5e-5)
    assert final[1, 1] == pytest.approx(0.016 + 0.0127 / 2, abs=5e-5)
    grid = np.searchsorted(stacked.t, stacked.trial.t)
    force = np.stack([stacked.trial.channels[f] for f in ("fx1", "fy1", "fx2", "fy2")], -1)
    noise = force - stacked.motion.force[grid].reshape(-1, 4)
    assert np.std(noise) == pytest.approx(0.012, rel=0.08)
    signals = task_space(stacked.trial, RIG)
    position = np.stack([signals.x1, signals.y1, signals.x2, signals.y2], -1)
    noise = position - stacked.motion.position[grid].reshape(-1, 4)
    assert np.std(noise) == pytest.approx(2e-4 * 0.12, rel=0.1)


def test_a_seed_gives_one_trial_in_which_a_slide_moves_its_block_along_the_ground(stacked):
    again = simulate_trials(STACK, RIG, [PAPER_BLOCKS], [3])[0]
    np.testing.assert_array_equal(again.trial.channels["fx1"], stacked.trial.channels["fx1"])
    together = simulate_trials(STACK, RIG, [PAPER_BLOCKS] * 3, [4, 3, 5])
    np.testing.assert_allclose(together[1].motion.force, stacked.motion.force, atol=1e-9)
    assert abs(together[0].boundaries - together[2].boundaries).max() > 0.05
    done = simulate_trials(SLIDE, RIG, [random_properties(SLIDE, 2)], [2])[0]
    start, stop = done.boundaries[1:3]
    x, y = done.motion.blocks[:, 0, 0], done.motion.blocks[:, 0, 1]
    before, after = (x[np.searchsorted(done.t, time)] for time in (start, stop))
    assert abs(after - before) > 0.02 and abs(before - x[0]) < 1e-3
    assert np.ptp(y[: np.searchsorted(done.t, done.boundaries[3])]) < 1e-4


@pytest.mark.parametrize("task", [TOWER, SLIDE])
def test_any_task_ends_as_described(task):
    blocks = random_properties(task, 1)
    done = simulate_trials(task, RIG, [blocks], [1])[0]
    assert np.isfinite(done.boundaries).all() and (np.diff(done.boundaries) > 0).all()
    support = dict(task.initial) | {move.object: move.to for move in task.performed}
    x, y = (dict(zip(task.objects, done.motion.blocks[-1, :, k], strict=True)) for k in (0, 1))
    for name, on in support.items():
        floor = 0.0 if on == GROUND else y[on] + blocks[on].height / 2
        assert y[name] - blocks[name].height / 2 == pytest.approx(floor, abs=3e-5)
        if on != GROUND:
            assert abs(x[name] - x[on]) < 3e-3


def test_what_cannot_be_performed_or_held_is_no_silent_success():
    slippery = {name: Block(b.weight, b.width, b.height, friction=0.02) for name, b in PAPER_BLOCKS.items()}
    assert np.isnan(simulate_trials(STACK, RIG, [slippery], [0])[0].boundaries).any()
    with pytest.raises(InputError, match="'block2' is missing"):
        simulate_trials(STACK, RIG, [{"block1": PAPER_BLOCKS["block1"]}], [0])[0]
    with pytest.raises(ValueError, match=r"grip\n.*expected \(low, high\), low <= high"):
        OperatorSettings(grip=(3.0, 1.0))
    short = {i: Finger(base=f.base, links=(0.08, 0.08)) for i, f in (RIG.fingers or {}).items()}
    with pytest.raises(InputError, match="finger 1"):
        simulate_trials(STACK, RIG.model_copy(update={"fingers": short}), [PAPER_BLOCKS], [0])[0]


def test_motion_is_of_minimum_jerk_and_a_cartesian_hand_records_positions():
    rig = Rig(rate=100.0, fingertip=RIG.fingertip, noise=Noise(position=1e-5, velocity=1e-3, force=0.01))
    done = simulate_trials(STACK, rig, [PAPER_BLOCKS], [0])[0]
    assert set(done.trial.channels) >= {"x1", "vy2", "fx1"} and done.trial.rate == pytest.approx(100.0)
    s = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(minimum_jerk(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])), [0, 0, 0.5, 1, 1])
    assert np.gradient(minimum_jerk(s), s).max() == pytest.approx(1.875, abs=1e-4)


def test_properties_come_from_the_json_of_identify(tmp_path):
    def entry(mean, **more):
        return {"unit": "m", "mean": mean, "sd": 1e-4} | more

    found = {name: {"weight": entry(0.4, unit="N"), "width": entry(0.02), "height": entry(0.015),
                    "friction": {"lower_bound": 1.4}} for name in STACK.objects}  # fmt: skip
    path = tmp_path / "identified.json"
    path.write_text(json.dumps({"properties": found}))
    assert read_properties(path, STACK)["block2"] == Block(0.4, 0.02, 0.015, 1.4)
    found["block2"]["height"] = None
    path.write_text(json.dumps({"properties": found}))
    with pytest.raises(InputError, match=r"block2\.height: found None; expected a positive number in m"):
        read_properties(path, STACK)
