"""The blind check: its simulator obeys physics, its seal holds, its scorer counts rightly."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

mujoco = pytest.importorskip("mujoco", reason="the blind check's simulator needs the extra `check`")

from experiments.blind_check import cases as sets  # noqa: E402
from experiments.blind_check.effects import CATALOGUE  # noqa: E402
from experiments.blind_check.generate import NOMINAL, generate  # noqa: E402
from experiments.blind_check.hand import load_rig  # noqa: E402
from experiments.blind_check.operator import Style, plan  # noqa: E402
from experiments.blind_check.perform import _check_touches, perform  # noqa: E402
from experiments.blind_check.scene import PIVOT, STEP, TASKS, Block, Servo, World, mjcf  # noqa: E402
from experiments.blind_check.sealing import BrokenSeal, unseal  # noqa: E402
from experiments.blind_check.signals import Sampling, sample, sense  # noqa: E402
from experiments.blind_check.worlds import draw_world, world_of  # noqa: E402
from hmmseg.io.rig import read_rig  # noqa: E402
from hmmseg.io.task import read_task  # noqa: E402
from simgap.effects import catalogue  # noqa: E402

RIG = load_rig(NOMINAL / "rig.toml")
BLOCKS = {"block1": Block(0.5, 0.017, 0.017, 0.6), "block2": Block(0.35, 0.026, 0.014, 0.6)}
HEALTHY = World(RIG.normal_stiffness, RIG.shear_stiffness)
TASK = TASKS["reversal"]
SERVO = Servo(0.12, 800.0, 19.0)


@pytest.fixture(scope="module")
def motion():
    return perform(plan(TASK, BLOCKS, HEALTHY, Style(), np.random.default_rng(4)), BLOCKS, HEALTHY)


def run(world: World, centres: dict[str, tuple[float, float]], seconds: float, command=(0.0, 0.2, 0.3, 0.2)):
    """A block world left alone, its fingers far away: the model, its data and heights at every step."""
    model = mujoco.MjModel.from_xml_string(mjcf(BLOCKS, centres, command, world, (SERVO, SERVO)))
    data = mujoco.MjData(model)
    data.qpos[[model.joint(n).qposadr[0] for n in ("x1", "z1", "x2", "z2")]] = command
    data.ctrl[:4] = command
    heights = []
    for _ in range(round(seconds / STEP)):
        mujoco.mj_step(model, data)
        heights.append(data.joint("z_block1").qpos[0])
    return model, data, np.array(heights)


def test_a_block_falls_freely_and_a_table_yields_by_the_load_and_tilts_about_its_pivot():
    _, _, z = run(HEALTHY, {"block1": (0.1, 0.15), "block2": (0.2, 0.007)}, 0.1)
    t = np.arange(1, len(z) + 1) * STEP
    # Semi-implicit Euler falls by g t (t + step) / 2.
    np.testing.assert_allclose(z, -RIG.gravity * t * (t + STEP) / 2, atol=1e-8)
    rest = {"block1": (0.115, 0.014 + 0.0085), "block2": (0.115, 0.007)}
    _, _, z = run(replace(HEALTHY, table_stiffness=1000.0), rest, 0.8)
    assert z[-1] == pytest.approx(-(0.5 + 0.35) / 1000.0, rel=0.01)
    _, data, z = run(replace(HEALTHY, tilt=0.03), {"block1": (0.165, 0.0102), "block2": (0.115, 0.007)}, 0.5)
    # It comes to lie flat on the slope: friction holds one corner, about which it turns.
    x = data.joint("x_block1").qpos[0]
    assert data.joint("turn_block1").qpos[0] == pytest.approx(0.03, abs=2e-4)
    along = 0.165 + x - PIVOT
    assert 0.0102 + z[-1] == pytest.approx(0.03 * along + 0.0085, abs=3e-5) and abs(x) < 5e-4


def test_fingers_carry_the_weight_and_pads_are_linear_and_do_not_slip(motion):
    touch, leave, meet, part = motion.boundaries[:4]
    air = (motion.t > leave + 0.05) & (motion.t < meet - 0.02)
    net = motion.force[air, 1] + motion.force[air, 3]
    a = np.gradient(np.gradient(motion.centres[:, 0, 1], motion.t), motion.t)[air]
    np.testing.assert_allclose(net, 0.5 * (1 + a / RIG.gravity), atol=0.01)
    free = (motion.t < touch - 0.02) | ((motion.t > part + 0.1) & (motion.t < motion.boundaries[4] - 0.02))
    assert np.abs(motion.force[free]).max() < 1e-4
    held = (motion.t > touch + 0.1) & (motion.t < part - 0.1)
    p, f = motion.position[held], motion.force[held]
    distance = p[:, 2] - p[:, 0] + (f[:, 0] - f[:, 2]) / RIG.normal_stiffness
    assert np.quantile(np.abs(distance - BLOCKS["block1"].width), 0.99) < 5e-6  # but for the shock of landing
    offset = p[:, 3] - p[:, 1] - (f[:, 3] - f[:, 1]) / RIG.shear_stiffness
    turned = offset - motion.turns[held, 0] * BLOCKS["block1"].width
    assert np.quantile(np.abs(turned - np.median(turned)), 0.99) < 8e-6


def test_worlds_are_drawn_apart_and_noise_is_as_the_rig_says_or_as_drawn(motion):
    signals = sense(motion, RIG, [], np.random.default_rng(0))
    _, noisy = sample(signals, Sampling(), np.random.default_rng(1))
    _, quiet = sample(signals, Sampling(), np.random.default_rng(1), noisy=False)
    for name, sd in (("q11", RIG.angle_noise), ("dq22", RIG.velocity_noise), ("fy1", RIG.force_noise)):
        assert np.std(noisy[name] - quiet[name]) == pytest.approx(sd, rel=0.2)
    drawn = [draw_world(np.random.default_rng(k)) for k in range(40)]
    assert {w.profile for w in drawn} == {"minimum_jerk", "trapezoid", "person"}
    assert len({w.task for w in drawn}) >= 4 and min(w.pace for w in drawn) < 0.6
    odd = Sampling(noise=(1.0, 1.0, 1.3), colour=0.3, differences=True)
    _, noisy = sample(signals, odd, np.random.default_rng(1))
    _, quiet = sample(signals, odd, np.random.default_rng(1), noisy=False)
    e = np.concatenate([noisy[c] - quiet[c] for c in ("fx1", "fy1", "fx2", "fy2")])
    assert np.std(e) == pytest.approx(1.3 * RIG.force_noise, rel=0.1)
    assert np.corrcoef(e[1:], e[:-1])[0, 1] == pytest.approx(0.3, abs=0.1)
    np.testing.assert_allclose(noisy["dq11"][1:], np.diff(noisy["q11"]) * RIG.rate)


def test_sensing_effects_are_what_the_contract_says(motion):
    def force(name: str, values: dict) -> np.ndarray:
        change = CATALOGUE[name].change(values)
        return sense(motion, RIG, change.stages, np.random.default_rng(0)).force

    f, t = motion.force, motion.t
    np.testing.assert_allclose(force("force_gain", {"gain": 0.1}), 1.1 * f)
    turned = force("sensor_rotation", {"angle1": 0.1, "angle2": -0.2})
    np.testing.assert_allclose(turned[:, 1], np.sin(0.1) * f[:, 0] + np.cos(0.1) * f[:, 1], atol=1e-12)
    late = force("force_lag", {"delay": 0.2})
    np.testing.assert_allclose(late[200:], f[:-200], atol=1e-6)
    slow = force("force_lowpass", {"time_constant": 0.1})[:, 0]
    residual = 0.1 * np.gradient(slow, t) + slow - f[:, 0]
    assert np.abs(residual).mean() < 0.02
    start = force("cable_force", {"stiffness": 2.0, "x0": 0.1, "y0": 0.0})[0]
    np.testing.assert_allclose(start - f[0], 2.0 * (motion.position[0] - [0.1, 0, 0.1, 0]), atol=1e-9)
    drift = force("force_drift", {"fx1": 0.02, "fy1": 0.0, "fx2": 0.0, "fy2": 0.0})[:, 0] - f[:, 0]
    assert drift[-1] == pytest.approx(0.02 * t[-1], rel=1e-6)


def test_an_off_centre_mass_makes_shears_unequal_and_stiff_pads_do_not_chatter():
    rng = lambda: np.random.default_rng(4)  # noqa: E731
    tips_round = replace(HEALTHY, pad_turning=0.02)
    moved = replace(tips_round, mass_offset=0.003)
    a = perform(plan(TASK, BLOCKS, tips_round, Style(), rng()), BLOCKS, tips_round)
    b = perform(plan(TASK, BLOCKS, moved, Style(), rng()), BLOCKS, moved)
    leave, meet = a.boundaries[1:3]
    air, n = (a.t > leave + 0.2) & (a.t < meet - 0.1), min(len(a.t), len(b.t))
    more = (b.force[:n] - a.force[:n])[air[:n]].mean(0)
    couple = 0.5 * 0.003 / 0.017
    # The heavier side sinks and the grip then pushes askew; pads that resist turning take some of it.
    np.testing.assert_allclose(more[[1, 3]], [-couple, couple], rtol=0.2)
    # At steps of 0.5 ms this one does, in its second carry.
    lower, upper = Block(0.6086, 0.02207, 0.01567, 0.766), Block(0.4259, 0.01764, 0.01382, 0.55)
    blocks = {"block1": upper, "block2": lower}
    stiff = replace(HEALTHY, normal_stiffness=4460.0, shear_stiffness=2830.0, pad_turning=4.8)
    style = Style(profile="trapezoid", stagger=(0.0, 0.0))
    motion = perform(plan(TASK, blocks, stiff, style, np.random.default_rng(0)), blocks, stiff)
    for leave, meet in (motion.boundaries[1:3], motion.boundaries[5:7]):
        air = (motion.t > leave + 0.1) & (motion.t < meet - 0.1)
        assert np.abs(np.diff(motion.force[air], 2, axis=0)).std() < 0.01  # N, between milliseconds


def test_every_contract_effect_is_there_and_sets_are_drawn_alike_and_keep_their_shares():
    known = {n for n, e in catalogue().items() if e.chosen}
    assert known <= set(CATALOGUE)
    for name, made in CATALOGUE.items():
        values = made.draw(np.random.default_rng(0), 0.5)
        assert values and all(np.isfinite(list(values.values()))), name
    assert sets.draw_cases(30, 3, RIG) == sets.draw_cases(30, 3, RIG)
    assert sets.draw_cases(30, 3, RIG) != sets.draw_cases(30, 4, RIG)
    drawn = [c.tier for c in sets.draw_cases(sum(sets.TIERS.values()), 3, RIG)]
    assert {t: drawn.count(t) for t in sets.TIERS} == sets.TIERS


def test_a_world_is_what_its_rig_and_label_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sets, "TRIALS", 1)
    generate(3, 11, tmp_path)
    for label in unseal(tmp_path)["cases"]:
        folder, world = tmp_path / "cases" / label["case"], world_of(label)
        rig = read_rig(folder / "rig.toml")  # as the judged code reads it
        assert (rig.rate, rig.fingertip.normal_stiffness) == (world.rate, world.normal_stiffness)
        assert rig.noise.force == pytest.approx(RIG.force_noise * world.sensors, rel=0.01)
        task = read_task(folder / "task.toml")
        assert len(task.moves) * 4 + 1 == len(label["subtasks"])
        assert [len(b) for b in label["boundaries"]] == [4 * len(task.moves)]
        t = np.loadtxt(folder / "trial_01.csv", delimiter=",", skiprows=1, usecols=0)
        np.testing.assert_allclose(np.diff(t), 1 / world.rate, atol=1.1e-5)


def test_a_finger_may_close_first_but_meets_no_other_block():
    together, apart = (perform(plan(TASK, BLOCKS, HEALTHY, Style(stagger=(s, s)), np.random.default_rng(4)),
                               BLOCKS, HEALTHY) for s in (0.0, 0.08))  # fmt: skip
    for motion in (together, apart):
        touch = np.searchsorted(motion.t, motion.boundaries[0])
        both = (motion.force[:, 0] > 2e-3) & (-motion.force[:, 2] > 2e-3)
        assert both[touch + 1] and not both[: touch - 1].any()
    pushed = lambda m: abs(m.centres[np.searchsorted(m.t, m.boundaries[0]), 0, 0] - m.centres[0, 0, 0])  # noqa: E731
    assert pushed(together) < 3e-4 < 8e-4 < pushed(apart)
    t, touched = np.arange(6.0), np.zeros((6, 2), bool)
    touched[[1, 2], [0, 0]] = touched[[4, 5], [1, 0]] = True
    _check_touches(t, touched, (2.5, 5.0), [0, 1])
    refused("another block", _check_touches, t, touched, (2.5, 4.5), [0, 1], error=ValueError)


def test_a_seal_is_kept_and_a_changed_label_is_caught(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sets, "TRIALS", 1)
    found, again = generate(2, 7, tmp_path), generate(2, 7, tmp_path / "again")
    assert found != again  # salted anew
    a, b = unseal(tmp_path), unseal(tmp_path / "again")
    assert a == b
    first = tmp_path / "cases" / "case_0000"
    csv = (first / "trial_01.csv").read_text()
    assert csv == (tmp_path / "again" / "cases" / "case_0000" / "trial_01.csv").read_text()
    assert json.loads((tmp_path / "seal.json").read_text())["sha256"] == found
    allowed = {"rig.toml", "task.toml", "trial_01.csv", "actual.toml", "options.json"}
    assert {p.name for p in first.iterdir()} <= allowed
    file = tmp_path / "sealed" / "labels.json"
    labels = json.loads(file.read_text())
    labels["cases"][0]["tier"] = "other"
    file.write_text(json.dumps(labels))
    refused(found, unseal, tmp_path, error=BrokenSeal)
