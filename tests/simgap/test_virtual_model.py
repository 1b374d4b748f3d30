"""The virtual model against closed forms, driven by a recording or an operator; `hmmseg simulate`."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from refusals import refused
from simgap_scenes import FAR, HAND, STACK, at, evolve, scene, tips

from experiments.benchmarks.haptic_loop import squeeze
from experiments.worlds import random_properties
from hmmseg.contact.decompose import subtasks
from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Finger, Noise, Rig, read_rig
from hmmseg.io.task import GROUND, BlockTask, Move, read_task
from hmmseg_cli.main import main
from simgap.world import animation
from simgap.world.dynamics import energy, interact, normal_force
from simgap.world.operator import OperatorSettings, minimum_jerk
from simgap.world.properties import PAPER_BLOCKS, Block
from simgap.world.replay import replay, residual_summary, smooth
from simgap.world.simulate import scene_files, simulate_trials
from simgap.world.virtual_model import RIGID_PAD, VirtualModel, physics, rollout, standing, substeps_for

STATES = [s.state for s in subtasks(STACK)]
TOWER = BlockTask({"a": "b", "b": "c", "c": GROUND}, (Move("a", GROUND), Move("b", "a"), Move("c", "b")))
SLIDE = BlockTask({"a": GROUND, "b": GROUND}, (Move("a", GROUND, slide=True), Move("b", "a")))


@pytest.fixture(scope="module")
def stacked():
    return simulate_trials(STACK, HAND, [PAPER_BLOCKS], [3])[0]


def places(done):
    return {name: float(done.motion.blocks[0, k, 0]) for k, name in enumerate(STACK.objects)}


def test_the_true_motion_gives_the_true_forces_and_a_replay_the_sensors_noise(stacked):
    constants = physics(HAND, [PAPER_BLOCKS[name] for name in STACK.objects])
    motion = stacked.motion
    again = rollout(constants, standing(constants, STACK, places(stacked)), jnp.asarray(motion.position),
                    jnp.asarray(motion.velocity), 1e-3, substeps_for(constants, 1e-3))  # fmt: skip
    assert np.sqrt(np.mean((again.force - motion.force) ** 2)) < 2e-3
    assert abs(again.blocks - motion.blocks).max() < 5e-5
    result = replay(stacked.trial, STACK, HAND, PAPER_BLOCKS, boundaries=stacked.boundaries)
    rest = residual_summary(result, stacked.boundaries, STATES)
    assert rest["free-motion"] < 1.15 and rest["hold-above-ground"] < 1.5
    end = result.motion.blocks[-1]
    np.testing.assert_allclose(end, stacked.motion.blocks[-1], atol=2e-3)


def test_steps_agree_with_the_rollout_and_reset_starts_over(stacked):
    model = VirtualModel(HAND, STACK, PAPER_BLOCKS, places(stacked))
    span = slice(1500, 2100)  # the first grasp
    position, velocity = stacked.motion.position[span], stacked.motion.velocity[span]
    forces = np.stack([model.step(p, v, 1e-3) for p, v in zip(position, velocity, strict=True)])
    constants = model.physics
    whole = rollout(constants, standing(constants, STACK, places(stacked)), jnp.asarray(position),
                    jnp.asarray(velocity), 1e-3, substeps_for(constants, 1e-3))  # fmt: skip
    np.testing.assert_allclose(forces, whole.force, atol=1e-9)
    assert abs(forces).max() > 1.0
    np.testing.assert_allclose(model.block_positions(), whole.blocks[-1], atol=1e-12)
    model.reset()
    np.testing.assert_array_equal(model.step(position[0], velocity[0], 1e-3), forces[0])


def test_rigid_fingertips_get_smaller_steps_and_a_step_refuses_what_is_no_motion():
    model = VirtualModel(HAND, STACK, PAPER_BLOCKS, {"block1": 0.12, "block2": 0.12})
    still = np.zeros((2, 2))
    refused("finite", model.step, [[np.nan, 0], [0, 0]], still, 1e-3, error=ValueError)
    refused("dt > 0", model.step, still, still, 0.0, error=ValueError)
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


@pytest.mark.parametrize("rate", [1000.0, 4000.0])
def test_the_virtual_block_is_passive_in_a_delayed_loop(rate):
    found = squeeze(rate, 4000.0, 2e-3, controlled=False, seconds=0.4)
    assert found["returned_J"] < 1e-9 and found["speed_left"] < 0.02


def test_a_trial_shows_its_task_its_widths_and_heights_and_the_rig_s_noise(stacked):
    assert stacked.boundaries.shape == (len(subtasks(STACK)) - 1,)
    assert (np.diff(stacked.boundaries) > 0.1).all()
    signals, (touch, leave, meet, part) = task_space(stacked.trial, HAND), stacked.boundaries[:4]
    t, gripped = signals.t, signals.grip > 0.1
    assert gripped[(t > touch + 0.06) & (t < part - 0.06)].all() and not gripped[t < touch - 0.01].any()
    carried = (t > leave + 0.1) & (t < meet - 0.1)
    assert np.mean(signals.fy[carried]) == pytest.approx(0.343, abs=0.01)
    width = 0.0159 - 2 * np.mean(signals.grip[carried]) / 4000
    assert np.mean(signals.distance[carried]) == pytest.approx(width, abs=3e-5)
    final = stacked.motion.blocks[-1]
    assert final[0, 1] == pytest.approx(0.016 / 2, abs=5e-5)
    assert final[1, 1] == pytest.approx(0.016 + 0.0127 / 2, abs=5e-5)
    grid = np.searchsorted(stacked.t, stacked.trial.t)
    force = np.stack([stacked.trial.channels[f] for f in ("fx1", "fy1", "fx2", "fy2")], -1)
    noise = force - stacked.motion.force[grid].reshape(-1, 4)
    assert np.std(noise) == pytest.approx(0.012, rel=0.08)
    position = np.stack([signals.x1, signals.y1, signals.x2, signals.y2], -1)
    noise = position - stacked.motion.position[grid].reshape(-1, 4)
    assert np.std(noise) == pytest.approx(2e-4 * 0.12, rel=0.1)


def test_a_seed_gives_one_trial_in_which_a_slide_moves_its_block_along_the_ground(stacked):
    again = simulate_trials(STACK, HAND, [PAPER_BLOCKS], [3])[0]
    np.testing.assert_array_equal(again.trial.channels["fx1"], stacked.trial.channels["fx1"])
    together = simulate_trials(STACK, HAND, [PAPER_BLOCKS] * 3, [4, 3, 5])
    np.testing.assert_allclose(together[1].motion.force, stacked.motion.force, atol=1e-9)
    assert abs(together[0].boundaries - together[2].boundaries).max() > 0.05
    done = simulate_trials(SLIDE, HAND, [random_properties(SLIDE, 2)], [2])[0]
    start, stop = done.boundaries[1:3]
    x, y = done.motion.blocks[:, 0, 0], done.motion.blocks[:, 0, 1]
    before, after = (x[np.searchsorted(done.t, time)] for time in (start, stop))
    assert abs(after - before) > 0.02 and abs(before - x[0]) < 1e-3
    assert np.ptp(y[: np.searchsorted(done.t, done.boundaries[3])]) < 1e-4


@pytest.mark.parametrize("task", [TOWER, SLIDE])
def test_any_task_ends_as_described(task):
    blocks = random_properties(task, 1)
    done = simulate_trials(task, HAND, [blocks], [1])[0]
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
    assert np.isnan(simulate_trials(STACK, HAND, [slippery], [0])[0].boundaries).any()
    one = [{"block1": PAPER_BLOCKS["block1"]}]
    refused("'block2' is missing", simulate_trials, STACK, HAND, one, [0])
    line = r"grip\n.*expected \(low, high\), low <= high"
    refused(line, OperatorSettings, grip=(3.0, 1.0), error=ValueError)
    short = {i: Finger(base=f.base, links=(0.08, 0.08)) for i, f in (HAND.fingers or {}).items()}
    other = HAND.model_copy(update={"fingers": short})
    refused("finger 1", simulate_trials, STACK, other, [PAPER_BLOCKS], [0])


def test_motion_is_of_minimum_jerk_and_a_cartesian_hand_records_positions():
    rig = Rig(rate=100.0, fingertip=HAND.fingertip, noise=Noise(position=1e-5, velocity=1e-3, force=0.01))
    done = simulate_trials(STACK, rig, [PAPER_BLOCKS], [0])[0]
    assert set(done.trial.channels) >= {"x1", "vy2", "fx1"} and done.trial.rate == pytest.approx(100.0)
    s = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(minimum_jerk(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])), [0, 0, 0.5, 1, 1])
    assert np.gradient(minimum_jerk(s), s).max() == pytest.approx(1.875, abs=1e-4)


G = 9.80665


def test_a_drop_falls_as_galileo_says_and_a_block_slides_with_the_closed_form_acceleration():
    constants = scene()
    fall = evolve(constants, at(constants, (0.0, 0.018)), FAR, 2.5e-4, 8000)
    t = 2.5e-4 * np.arange(1, 8001)
    before = t < np.sqrt(2 * 0.01 / G)
    np.testing.assert_allclose(fall.y[0][before], 0.018 - G * t[before] ** 2 / 2, atol=1e-12)
    assert float(fall.y[0][-1]) == pytest.approx(0.008 - 0.4 / 1e5, abs=1e-9)
    assert float(fall.vy[0][-1]) == pytest.approx(0.0, abs=1e-9)
    tilt = float(np.arctan(1.5 * 0.5))
    constants = scene(tilt=tilt)
    path = evolve(constants, at(constants, (0.0, 0.008)), FAR, 2.5e-4, 4000)
    speed, expected = np.hypot(path.vx[0], path.vy[0]), G * (np.sin(tilt) - 0.5 * np.cos(tilt))
    assert float(speed[-1] - speed[1999]) / (2000 * 2.5e-4) == pytest.approx(expected, rel=1e-3)


def oscillation(pad_time: float, h: float, end: float = 0.02) -> float:
    """Error of a gripped block's swing against the damped spring's closed form, at the end [m]."""
    constants = scene(pad_time=pad_time)
    mass, start = 0.4 / G, 1e-4
    state = at(constants, (start, 0.03))
    state = state._replace(vy=(jnp.asarray(0.0),))
    fingers = tips(-0.01 + 5e-4, 0.03, 0.01 - 5e-4, 0.03)
    path = evolve(constants, state, fingers, h, round(end / h))
    k, c = 8000.0, 8000.0 * pad_time
    rate = c / (2 * mass)
    w = np.sqrt(k / mass - rate**2)
    exact = start * np.exp(-rate * end) * (np.cos(w * end) + rate / w * np.sin(w * end))
    return float(path.x[0][-1]) - exact


def test_a_spring_converges_at_second_order_and_a_damped_one_at_first_or_better():
    errors = np.abs([oscillation(0.0, h) for h in (4e-4, 2e-4, 1e-4, 5e-5)])
    orders = np.log2(errors[:-1] / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.1)
    assert errors[-1] < 1e-7
    errors = np.abs([oscillation(5e-4, h) for h in (2e-4, 1e-4, 5e-5)])
    assert (np.log2(errors[:-1] / errors[1:]) > 0.9).all() and errors[-1] < 2e-6


@pytest.mark.parametrize("share", [0.5, 0.99])
def test_a_block_sticks_on_an_incline_below_the_angle_of_friction(share):
    tilt = float(np.arctan(share * 0.5))
    constants, height = scene(tilt=tilt), 0.008 / np.cos(tilt)
    path = evolve(constants, at(constants, (0.0, height - 2e-6)), FAR, 2.5e-4, 40000)
    settled = path.x[0][4000:]
    assert float(jnp.ptp(settled)) < 1e-9  # ten seconds, no creep


def test_energy_is_kept_by_an_undamped_bounce_and_never_made_by_contact():
    constants, spread = scene(support_damping=0.0), []
    for h in (1e-4, 5e-5, 2.5e-5):
        path = evolve(constants, at(constants, (0.0, 0.0085)), FAR, h, round(2.0 / h))
        held = jax.jit(jax.vmap(lambda s: energy(constants, s, FAR)))(path)
        spread.append(float(jnp.ptp(held)) / (0.4 * 0.0005))  # over a hundred bounces
    assert spread[0] < 0.05 and spread[1] < spread[0] / 3 and spread[2] < spread[1] / 3
    constants = scene([Block(0.4, 0.02, 0.016), Block(0.3, 0.025, 0.012)])
    path = evolve(constants, at(constants, (0.0, 0.035), (0.004, 0.0065)), FAR, 5e-5, 20000)
    held = np.asarray(jax.jit(jax.vmap(lambda s: energy(constants, s, FAR)))(path))
    lost = held[0] - held[-1]
    assert lost > 0.4 * 0.014  # the upper block fell that far and rests
    # Within an impact the scheme's energy swings by the square of the step; none is left over.
    assert (held - np.minimum.accumulate(held)).max() < 0.02 * lost
    assert (held[::500] - np.minimum.accumulate(held[::500])).max() < 1e-4 * lost


def test_stacks_stay_and_blocks_that_meet_in_the_air_keep_their_momentum():
    constants = scene([Block(0.4, 0.02, 0.016), Block(0.3, 0.02, 0.016)])
    state = at(constants, (-0.015, 1.0), (0.015, 1.0))
    state = state._replace(vx=(jnp.asarray(0.3), jnp.asarray(-0.2)))
    path = evolve(constants, state, FAR, 2.5e-4, 400)
    momentum = (0.4 * path.vx[0] + 0.3 * path.vx[1]) / G
    np.testing.assert_allclose(momentum, momentum[0], atol=1e-15)
    assert float(path.vx[0][-1]) < 0.3 - 0.05  # they did meet
    assert float(path.x[1][-1] - path.x[0][-1]) > 0.0199  # and did not pass through
    blocks = [Block(0.3, 0.018, 0.016), Block(0.6, 0.025, 0.013), Block(0.4, 0.02, 0.018)]
    constants = scene(blocks)
    path = evolve(constants, at(constants, (0.003, 0.039), (0.0, 0.0245), (-0.002, 0.009)), FAR, 2.5e-4,
                  40000)  # fmt: skip
    for k in range(3):
        assert float(jnp.ptp(path.x[k])) < 1e-12 and float(jnp.ptp(path.y[k][8000:])) < 1e-10
    assert float(path.y[0][-1]) == pytest.approx(0.039 - (1.3 + 0.9 + 0.3) / 1e5, abs=1e-8)


def test_a_held_block_neither_sinks_nor_turns_loose_and_slides_in_too_weak_a_grip():
    constants = scene()
    fingers = tips(-0.01 + 5e-4, 0.03, 0.01 - 5e-4, 0.03)
    path = evolve(constants, at(constants, (0.0, 0.03)), fingers, 2.5e-4, 40000)
    assert float(path.y[0][-1]) == pytest.approx(0.03 - 0.4 / 5000, abs=1e-9)
    assert float(jnp.ptp(path.y[0][4000:])) < 1e-9
    constants = scene([Block(0.4, 0.02, 0.016, friction=0.1)])
    fingers = tips(-0.01 + 2.5e-4, 0.03, 0.01 - 2.5e-4, 0.03)  # 1 N of grip carries 0.2 N
    path = evolve(constants, at(constants, (0.0, 0.03)), fingers, 2.5e-4, 100)
    rate = float(path.vy[0][99] - path.vy[0][59]) / (40 * 2.5e-4)
    assert rate == pytest.approx(-G * (0.4 - 0.2) / 0.4, rel=1e-3)


@pytest.mark.parametrize(("depth", "rate", "force"), [(1e-3, 0.0, 4.0), (1e-3, 0.1, 4.8), (-1e-3, 5.0, 0.0),
                                                      (1e-3, -5.0, 0.0)])  # fmt: skip
def test_a_spring_pushes_by_its_compression_and_never_pulls(depth, rate, force):
    assert float(normal_force(*map(jnp.asarray, (4000.0, 8.0, depth, rate)))) == pytest.approx(force)


def grasp_and_lift(weight, width, stiffness):
    constants = scene()._replace(weight=(weight,), width=(width,), pad_normal=(stiffness, stiffness))
    t = jnp.arange(400.0) * 1e-3
    close = 0.01203 - 0.0026 * jnp.clip(t / 0.1, 0, 1)
    lift = 0.008 + 0.004 * jnp.clip((t - 0.15) / 0.1, 0, 1) - 0.0042 * jnp.clip((t - 0.28) / 0.1, 0, 1)
    position = jnp.stack([jnp.stack([-close, lift], -1), jnp.stack([close, lift], -1)], 1)
    velocity = jnp.gradient(position, 1e-3, axis=0)
    return rollout(constants, at(constants, (0.0, 0.008)), position, velocity, 1e-3, 4).force


def test_gradients_through_contact_agree_with_differences_and_are_finite_at_touch():
    point = [jnp.asarray(0.4), jnp.asarray(0.02), jnp.asarray(4000.0)]
    loss = jax.jit(lambda *properties: jnp.sum(grasp_and_lift(*properties) ** 2) / 400)
    exact = jax.grad(loss, argnums=(0, 1, 2))(*point)
    for k, value in enumerate(exact):
        h = 1e-7 * float(point[k])
        up, down = ([p + sign * h if k == j else p for j, p in enumerate(point)] for sign in (1.0, -1.0))
        assert np.isfinite(value) and value != 0.0
        assert float(value) == pytest.approx(float(loss(*up) - loss(*down)) / (2 * h), rel=1e-4)
    constants = scene()
    state = at(constants, (0.0, 0.008))  # resting at depth 0, tips at depth 0

    def total(weight, x):
        fingers = tips(-0.01, 0.008, 0.01, 0.008)._replace(x=(-x, x))
        _, loads = interact(constants._replace(weight=(weight,)), state, fingers)
        return loads.fx[0] + loads.block_y[0]

    for value in jax.jit(jax.grad(total, argnums=(0, 1)))(jnp.asarray(0.4), jnp.asarray(0.01)):
        assert np.isfinite(value)


TASK = '[objects.block1]\non = "ground"\n[[moves]]\nobject = "block1"\nto = "ground"\n'
RIG = scene_files(STACK, HAND, PAPER_BLOCKS)["rig.toml"]


@pytest.fixture
def inputs(tmp_path) -> list[str]:
    (tmp_path / "task.toml").write_text(TASK)
    (tmp_path / "rig.toml").write_text(RIG)
    return ["--task", str(tmp_path / "task.toml"), "--rig", str(tmp_path / "rig.toml"), "--quiet"]


def test_trials_are_written_as_a_folder_of_recordings(tmp_path, inputs):
    out, report = tmp_path / "out", tmp_path / "out.json"
    args = ["simulate", *inputs, "--trials", "2", "--output", str(out), "--json", str(report)]
    assert main([*args, "--figures", str(tmp_path / "figures")]) == 0
    rig = read_rig(out / "rig.toml")
    assert rig == read_rig(tmp_path / "rig.toml")
    assert read_task(out / "task.toml") == read_task(tmp_path / "task.toml")
    document = json.loads(report.read_text())
    assert document["format"] == "hmmseg.simulate/1"
    assert document["properties"]["block1"]["weight"] == 0.343  # the paper's
    for k, row in enumerate(document["trials"], 1):
        trial = read_trial(out / f"trial_{k:02d}.csv", rig)
        truth = json.loads((out / f"truth/trial_{k:02d}.json").read_text())
        assert truth["seed"] == row["seed"]
        assert truth["boundaries"] == pytest.approx(row["boundaries"], abs=1e-6)
        assert len(trial.t) >= 100  # five seconds a move, or what the operator needs
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "trial_01_signals.png", "trial_02_signals.png"}  # fmt: skip
    assert all((tmp_path / name).exists() for name in document["files"])
    again = tmp_path / "again"
    assert main([*args[:-4], "--output", str(again), "--json", str(report)]) == 0
    assert (again / "trial_02.csv").read_bytes() == (out / "trial_02.csv").read_bytes()


@pytest.mark.parametrize("more", [
    '[columns]\nt = {from = "stamp", unit = "ms"}\nx1 = {from = "left [mm]", unit = "mm"}\n',
    '[gripper]\nposition = ["x", "y", "z"]\nopening = "w"\nwrench = ["fx", "fy", "fz"]\n'])  # fmt: skip
def test_the_rig_that_is_written_reads_the_trials_that_are(tmp_path, inputs, more):
    (tmp_path / "rig.toml").write_text("rate = 50.0\n" + more)
    out = tmp_path / "out"
    assert main(["simulate", *inputs, "--output", str(out)]) == 0
    trial = ["--task", str(out / "task.toml"), "--rig", str(out / "rig.toml"), "--quiet"]
    assert main(["segment", str(out / "trial_01.csv"), *trial]) == 0


def test_a_replay_predicts_the_recording_s_forces(tmp_path, inputs):
    made, out = tmp_path / "made", tmp_path / "replayed"
    assert main(["simulate", *inputs, "--output", str(made)]) == 0
    report = tmp_path / "replay.json"
    args = ["simulate", *inputs, "--properties", str(made / "actual.toml")]
    assert main([*args, "--replay", str(made / "trial_01.csv"), "--output", str(out), "--json", str(report),
                 "--figures", str(tmp_path / "figures")]) == 0  # fmt: skip
    rest = json.loads(report.read_text())["replay"]["net_force_residual_over_noise"]
    assert rest["free-motion"] < 1.5 and rest["hold-above-ground"] < 1.5
    rig = read_rig(out / "rig.toml")
    recorded, predicted = (read_trial(folder / "trial_01.csv", rig) for folder in (made, out))
    assert (recorded.channels["q11"] == predicted.channels["q11"]).all()
    assert abs(recorded.channels["fx1"] - predicted.channels["fx1"]).mean() < 0.05


@pytest.mark.parametrize(("more", "message"), [
    (["--output", "."], "would replace the input"),
    (["--replay", "trial.csv", "--trials", "2"], "goes with neither"),
    (["--properties", "none.json"], "none.json: no such file"),
    (["--operator", "operator.toml"], "unknown key; expected one of")])  # fmt: skip
def test_what_is_refused_writes_nothing(tmp_path, inputs, more, message, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "operator.toml").write_text("gripp = 2.0\n")
    before = sorted(tmp_path.iterdir())
    assert main(["simulate", *inputs, *more]) == 2 and message in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_the_operator_does_as_told(tmp_path, inputs, monkeypatch):
    monkeypatch.setattr(animation, "FRAMES", 2.0)
    (tmp_path / "operator.toml").write_text("grip = 1.5\ntremor = 0.0\nwander = [0.0, 0.0]\n")
    args = ["simulate", *inputs, "--operator", str(tmp_path / "operator.toml")]
    assert main([*args, "--output", str(tmp_path / "out"), "--animation"]) == 0
    trial = read_trial(tmp_path / "out/trial_01.csv", read_rig(tmp_path / "rig.toml"))
    touch, leave = json.loads((tmp_path / "out/truth/trial_01.json").read_text())["boundaries"][:2]
    held = (trial.t > leave + 0.2) & (trial.t < leave + 0.8)
    assert leave > touch
    grip = (trial.channels["fx1"] - trial.channels["fx2"])[held] / 2
    assert grip.mean() == pytest.approx(1.5, abs=0.06)
    with Image.open(tmp_path / "out/trial_01.gif") as film:
        assert film.n_frames == pytest.approx(trial.t[-1] * 2.0, abs=2)
