"""From readings to task space and features: kinematics, noise, rates, filters and hands that roll."""

from dataclasses import replace

import jax
import numpy as np
import pandas as pd
import pytest
from demo_recordings import RIG, TRIALS
from hand_signals import JOINTED, signals_of
from refusals import refused
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import lfilter, savgol_filter

from experiments.worlds import WORLDS, scene, trials_of
from hmmseg.contact.equations import rolled_offset, turned
from hmmseg.hand.kinematics import forward, inverse, joint_velocity, require_reach, tip_velocity
from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import late_differences, one_sided, remove_roll, task_space, timely
from hmmseg.hand.tool import smooth
from hmmseg.io.rig import Finger, Fingertip, Noise, Rig, parse_rig
from hmmseg.io.trial import CARTESIAN_CHANNELS, JOINT_CHANNELS, ROLL, Trial
from hmmseg.online.watcher import Watcher
from hmmseg.robust import bridged, robust_sd, weighted_median, white_sd
from hmmseg.segmentation.emissions import acceleration, features, noise_sd, thin
from hmmseg.segmentation.pads import STEP, _joined
from hmmseg.segmentation.stretches import lagging

FLATTENS = 0.03  # s in which a block that landed on its corner comes to lie flat, and the hand with it


def rolling_trial(number: int, angle: float, world: str = "50 Hz") -> tuple[Trial, Rig, np.ndarray]:
    """A trial whose hand and block roll by up to `angle` [rad] from lift to landing, rig, boundaries [s]."""
    (judged,) = trials_of(WORLDS[world], [number])
    s, b = task_space(judged.trial, judged.rig), judged.boundaries
    roll = np.zeros(s.t.size)
    for lift, land in b.reshape(-1, 4)[:, 1:3]:
        share = np.clip((s.t - lift) / (land - lift), 0, 1)
        growing = share**2 * (3 - 2 * share) * (s.t <= land)
        roll += angle * (growing + np.exp(-np.maximum(s.t - land, 0) / FLATTENS) * (s.t > land))
        angle = -angle  # the other way round with the next block
    width = float(np.median(s.distance[(s.t > b[0]) & (s.t < b[3])]))
    c = {name: getattr(s, name).copy() for name in CARTESIAN_CHANNELS}
    higher = width / 2 * np.abs(np.sin(roll))
    cos, sin = np.cos(roll), np.sin(roll)
    pace = np.gradient(roll, s.t)
    for kind in "f", "v", "":
        x, y = (c[f"{kind}{a}2"] - c[f"{kind}{a}1"] for a in "xy")
        dx, dy = x * cos - y * sin, x * sin + y * cos
        if kind == "v":
            dx, dy = dx - pace * s.distance * sin, dy + pace * s.distance * cos
        for a, new in zip("xy", (dx, dy), strict=True):
            mean = (c[f"{kind}{a}1"] + c[f"{kind}{a}2"]) / 2
            mean = mean + (a == "y") * {"": higher, "v": np.gradient(higher, s.t), "f": 0.0}[kind]
            c[f"{kind}{a}1"], c[f"{kind}{a}2"] = mean - new / 2, mean + new / 2
    sd_x, sd_y, sd_v = (float(np.median(v)) * np.sqrt(2) for v in (s.sd_x, s.sd_y, s.sd_vx))
    noise = Noise(position=float(np.hypot(sd_x, sd_y) / np.sqrt(2)), velocity=sd_v,
                  force=judged.rig.noise.force)  # fmt: skip
    rig = Rig(rate=judged.rig.rate, gravity=judged.rig.gravity, fingertip=judged.rig.fingertip, noise=noise)
    return replace(judged.trial, channels=c | {ROLL: roll}), rig, b


CARTESIAN = parse_rig({"noise": {"position": 1e-4, "velocity": 0.01, "force": 0.02}})


def cartesian(samples=12) -> pd.DataFrame:
    values = np.random.default_rng(0).normal(scale=0.1, size=(samples, len(CARTESIAN_CHANNELS)))
    return pd.DataFrame({"t": np.arange(samples) * 0.05} | dict(zip(CARTESIAN_CHANNELS, values.T,
                                                                    strict=True)))  # fmt: skip


def test_noise_of_positions_and_of_derived_velocities_agrees_with_samples():
    rng, n = np.random.default_rng(1), 20_000
    frame = pd.DataFrame({"t": np.arange(n) * 1e-3, **{name: 0.0 for name in JOINT_CHANNELS}})
    for name, angle in (("q11", -2.0), ("q12", -0.1), ("q21", -1.1), ("q22", -3.0)):
        frame[name] = angle + rng.normal(scale=2e-4, size=n)
        frame[f"d{name}"] = rng.normal(scale=0.03, size=n)
    signals = task_space(read_trial(frame, JOINTED), JOINTED)
    for axis in ("x", "y", "vx", "vy"):
        both = np.concatenate([getattr(signals, f"{axis}1"), getattr(signals, f"{axis}2")]).reshape(2, -1)
        rms = np.sqrt(both.var(axis=1).mean())  # `sd_*` is the fingers' root mean square
        assert getattr(signals, f"sd_{axis}").mean() == pytest.approx(rms, rel=0.03)
    assert signals.sd_force == 0.012
    rng, n = np.random.default_rng(2), 20_000
    frame = pd.DataFrame({"t": np.arange(n) * 0.01,
                          **{name: 0.0 for name in CARTESIAN_CHANNELS if "v" not in name}})  # fmt: skip
    for name in ("x1", "y1", "x2", "y2"):
        frame[name] = rng.normal(scale=1e-4, size=n)
    signals = task_space(read_trial(frame, CARTESIAN), CARTESIAN)
    assert signals.sd_vx[5] == pytest.approx(signals.vx1.std(), rel=0.03)
    assert signals.sd_vy[0] == pytest.approx(2 * signals.sd_vy[5])


def test_forces_and_places_of_a_grip():
    s = signals_of(np.zeros(1), fx1=2.0, fx2=-1.5, fy1=0.3, fy2=0.1, x1=0.1, x2=0.13, y1=0.02, y2=0.05)
    found = [getattr(s, n)[0] for n in ("grip", "fx", "fy", "shear", "distance", "offset", "x", "y")]
    assert found == pytest.approx([1.5, 0.5, 0.4, 0.1, 0.03, 0.03, 0.115, 0.035])


def test_cartesian_velocities_given_or_derived():
    frame = cartesian(200)
    given = task_space(read_trial(frame, CARTESIAN), CARTESIAN)
    np.testing.assert_array_equal(given.vx1, frame["vx1"])
    assert given.sd_vx == pytest.approx(np.full(200, 0.01))
    t = frame["t"].to_numpy()
    frame["x1"], frame["x2"] = t**2 / 100, t**2 / 100 + 0.1
    frame.loc[7, "x1"] = np.nan
    derived = task_space(read_trial(frame.drop(columns=["vx1", "vy2"]).assign(vx2=np.nan), CARTESIAN),
                         CARTESIAN)  # fmt: skip
    assert np.isnan(derived.vx1[7])
    np.testing.assert_allclose(np.delete(derived.vx1, 7)[1:-1], np.delete(t, 7)[1:-1] / 50, atol=1e-12)
    np.testing.assert_allclose(derived.vx2[1:-1], t[1:-1] / 50, atol=1e-12)
    np.testing.assert_array_equal(derived.vy1, frame["vy1"])


HAND = {1: Finger(base=(0.05, 0.17), links=(0.12, 0.10)), 2: Finger(base=(0.21, 0.17), links=(0.12, 0.12))}
RNG = np.random.default_rng(0)
TIPS = np.stack([RNG.uniform(0.08, 0.17, 50), RNG.uniform(0.005, 0.08, 50)], -1)


def test_angles_of_a_known_pose_and_a_tip_out_of_reach():
    # Both links at right angles: link 1 straight down, link 2 level, as drawn by hand.
    q = inverse(HAND[1], 1, np.array([0.05 + 0.10, 0.17 - 0.12]))
    np.testing.assert_allclose(q, [-np.pi / 2, 0.0], atol=1e-12)
    q = inverse(HAND[2], 2, np.array([0.21 - 0.12, 0.17 - 0.12]))
    np.testing.assert_allclose(q, [-np.pi / 2, -np.pi], atol=1e-12)
    line = r"finger 1: the task needs a tip 0\.5\d+ m from its base"
    refused(line, require_reach, HAND[1], 1, np.array([[0.6, 0.17]]))
    require_reach(HAND[1], 1, TIPS)


@pytest.mark.parametrize("number", [1, 2])
def test_angles_and_velocities_of_tips_are_inverse_and_agree_with_jax(number):
    finger, speed = HAND[number], RNG.uniform(-0.2, 0.2, TIPS.shape)
    q = inverse(finger, number, TIPS)
    np.testing.assert_allclose(forward(finger, q), TIPS, atol=1e-14)
    rate = joint_velocity(finger, q, speed)
    np.testing.assert_allclose(tip_velocity(finger, q, rate), speed, atol=1e-13)
    _, by_jax = jax.jvp(lambda z: forward(finger, z), (jax.numpy.asarray(q),), (jax.numpy.asarray(rate),))
    np.testing.assert_allclose(by_jax, speed, atol=1e-13)


def _with_differences(trial: Trial, over: int) -> Trial:
    channels = dict(trial.channels)
    for name in ("q11", "q12", "q21", "q22"):
        q, first = channels[name], np.zeros(over)
        channels[f"d{name}"] = np.r_[first, (q[over:] - q[:-over]) / (trial.t[over:] - trial.t[:-over])]
    return replace(trial, channels=channels)


@pytest.mark.parametrize("over", [1, 2, 3])
def test_velocities_that_repeat_the_positions_are_replaced_by_central_differences(over):
    late = _with_differences(TRIALS[0], over)
    found = timely(task_space(late, RIG), late)
    assert found.derived
    truth, raw = task_space(TRIALS[0], RIG), task_space(late, RIG)
    moving = slice(5, -5)
    error = [np.sqrt(np.mean((s.vy - truth.vy)[moving] ** 2)) for s in (found, raw)]
    assert error[0] < 0.6 * error[1]


def test_velocities_of_their_own_stay_and_rates_beside_a_kink_are_of_their_own_side():
    signals = task_space(TRIALS[0], RIG)
    assert timely(signals, TRIALS[0]) is signals
    still = np.zeros(50)  # positions that never change prove nothing
    assert not late_differences(np.arange(50) * 0.05, still, still)
    t = np.arange(40) * 0.05
    kink = t[20]
    left, right = one_sided(t, np.where(t < kink, 0.3 * t + 0.1 * t**2, 0.3 * kink + 0.1 * kink**2))[0]
    assert left[20] == pytest.approx(0.3 + 0.2 * kink, rel=1e-6) and right[20] == pytest.approx(0.0, abs=1e-9)
    t, rng = np.arange(20_000) * 0.05, np.random.default_rng(1)
    rates, noise = one_sided(t, rng.standard_normal(t.size))
    assert rates[:, 5:-5].std() == pytest.approx(noise, rel=0.03)


def made_signals(t, rng, sd=0.1):
    columns = {name: rng.normal(size=t.size) * sd for name in CARTESIAN_CHANNELS}
    return signals_of(t, sd, **columns, sd_x=sd, sd_y=sd, sd_vx=sd, sd_vy=sd)


def test_noise_is_found_beneath_a_smooth_signal_and_of_means_and_distances():
    rng, t = np.random.default_rng(0), np.arange(2000) * 0.05
    noise = noise_sd(np.sin(t) + 0.01 * rng.normal(size=t.size))
    assert noise == pytest.approx(0.01, rel=0.1)
    stepped = np.sin(t) + 0.01 * rng.normal(size=t.size) + 5.0 * (t > 40) + 5.0 * (t > 70)
    assert noise_sd(stepped) == pytest.approx(0.01, rel=0.1)
    rig = Rig(noise=Noise(position=3e-5, velocity=4e-3, force=0.01), fingertip=Fingertip())
    t = np.arange(40) * 0.05
    trial = Trial("made.csv", t, {name: np.sin(t) for name in CARTESIAN_CHANNELS})
    f = features(task_space(trial, rig), rig)
    np.testing.assert_allclose(f.sd_y, 3e-5 / np.sqrt(2))
    np.testing.assert_allclose(f.sd_d, 3e-5 * np.sqrt(2))
    np.testing.assert_allclose(f.sd_vx, 4e-3 / np.sqrt(2))


def test_thinning_averages_groups_and_their_noise():
    rng, t = np.random.default_rng(1), np.arange(4003) / 1000
    signals = made_signals(t, rng)
    thinned = thin(signals)
    assert thinned.t.size == 160  # 1000 Hz to 40 Hz, the last three samples left over
    np.testing.assert_allclose(thinned.fx1, signals.fx1[:4000].reshape(160, 25).mean(axis=1))
    np.testing.assert_allclose(thinned.t, t[:4000].reshape(160, 25).mean(axis=1))
    np.testing.assert_allclose(thinned.sd_x, 0.1 / 5)
    assert thinned.sd_force == pytest.approx(0.1 / 5)
    assert thinned.fx1.std() == pytest.approx(thinned.sd_force, rel=0.2)
    read = thin(signals, window=6e-3)  # a short window reads the first samples of each group
    np.testing.assert_allclose(read.fx1, signals.fx1[:4000].reshape(160, 25)[:, :6].mean(axis=1))
    assert read.sd_force == pytest.approx(0.1 / np.sqrt(6))


def test_means_over_time_skip_missing_values():
    t = np.arange(8) / 80
    signals = made_signals(t, np.random.default_rng(2))
    signals.fy1[[0, 2, 3]] = np.nan
    thinned = thin(signals)
    np.testing.assert_allclose(thinned.fy1[0], signals.fy1[1])
    assert np.isnan(thinned.fy1[1])
    np.testing.assert_allclose(thinned.fy1[2:], signals.fy1[4:].reshape(2, 2).mean(axis=1))
    t = np.array([0.0, 0.1, 0.25, 0.3, 0.5, 0.6])
    velocity = 3 * t**2 + 1
    np.testing.assert_allclose(acceleration(t, velocity)[1:-1], 6 * t[1:-1], rtol=1e-12)
    velocity[2] = np.nan
    found = acceleration(t, velocity)
    assert np.isnan(found[2])
    np.testing.assert_allclose(found[[1, 3, 4]], 6 * t[[1, 3, 4]], rtol=1e-12)
    assert np.isnan(acceleration(t[:2], velocity[:2])).all()


@pytest.mark.parametrize("deriv", [0, 1, 2])
@pytest.mark.parametrize(("size", "window"), [(40, 0.05), (200, 0.25), (7, 0.07), (9, 0.5)])
def test_local_parabolas_are_those_of_savitzky_and_golay(size, window, deriv):
    t, values = 0.01 * np.arange(size), np.random.default_rng(size).normal(size=(size, 2))
    length = min(max(3, round(window / 0.01) // 2 * 2 + 1), (size - 1) // 2 * 2 + 1)
    expected = savgol_filter(values, length, 2, deriv=deriv, delta=0.01, axis=0, mode="interp")
    np.testing.assert_allclose(smooth(t, values, deriv, window), expected, atol=1e-12 * 100.0**deriv)


def test_filters_and_distances_between_samples_are_those_of_every_step():
    rng = np.random.default_rng(1)
    values, kept = rng.normal(size=(2, 3, 50)), np.array([0.0, 0.3, 0.95])
    place, share = np.array([0, 0, 7, 20, 48]), rng.uniform(size=5)
    for c, k in enumerate(kept):
        every = lfilter([1 - k], [1, -k], values, zi=k * values[..., :1])[0]
        expected = (1 - share) * every[..., place] + share * every[..., place + 1]
        np.testing.assert_allclose(lagging(values, kept, place, share)[..., c], expected, rtol=1e-14)
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.01, 0.05, size=20))
    distance, rate = rng.normal(size=(2, 20))
    clock = np.minimum(np.arange(t[0], t[-1] + STEP, STEP), t[-1])
    found = _joined(t, distance, rate)
    np.testing.assert_allclose(found, CubicHermiteSpline(t, distance, rate)(clock), atol=1e-12)


def test_robust_numbers_hardly_move_with_wild_samples_weights_and_gaps():
    residual = np.random.default_rng(0).normal(0.0, 2.0, 100_000)
    assert robust_sd(residual) == pytest.approx(2.0, rel=0.01)
    residual[::20] = 1e6
    assert robust_sd(residual) == pytest.approx(2.0, rel=0.08)
    rng = np.random.default_rng(2)
    values, times = rng.normal(size=31), rng.integers(1, 9, 31)
    times[0] += 1 - times.sum() % 2  # an odd number of values has one in the middle
    assert weighted_median(values, times.astype(float)) == np.median(np.repeat(values, times))
    assert weighted_median(np.array([np.nan, 1.0, 9.0]), np.array([9.0, 1.0, 3.0])) == 9.0  # of what is there
    values = np.array([0.0, np.nan, np.nan, 9.0])
    np.testing.assert_allclose(bridged(values), [0, 3, 6, 9])
    np.testing.assert_allclose(bridged(values, np.array([0.0, 1.0, 8.0, 9.0])), [0, 1, 8, 9])
    assert bridged(np.ones(3)).tolist() == [1.0, 1.0, 1.0]
    refused("empty", bridged, np.full(3, np.nan), error=ValueError)


@pytest.mark.parametrize("order", [1, 2, 4])
def test_white_noise_is_seen_on_a_bending_signal(order):
    t = np.arange(100_000)
    signal = np.sin(t / 500) + np.random.default_rng(1).normal(0.0, 0.1, t.size)
    assert white_sd(signal, order) == pytest.approx(0.1, rel=0.02)


def test_a_recorded_roll_is_taken_out_by_the_equations_of_a_rolled_block():
    corners = np.array([[-0.03, 0.0], [0.03, 0.0]])
    x, y = turned(*corners.T, 0.02)
    assert y[1] - y[0] == pytest.approx(rolled_offset(0.06, 0.02), rel=1e-4)
    assert np.hypot(x, y) == pytest.approx([0.03, 0.03])
    rolled, _, _ = rolling_trial(76200, 0.05)
    level, _, _ = rolling_trial(76200, 0.0)
    found = remove_roll(rolled)
    for name in ("x1", "x2", "fx1", "fy1", "fx2", "fy2"):
        np.testing.assert_allclose(found.channels[name], level.channels[name], atol=1e-9)
    # The hand is higher by what the corner hangs lower; what the fingers differ by is as it was.
    for name in ("y", "vy"):
        apart, before = (c[f"{name}2"] - c[f"{name}1"] for c in (found.channels, level.channels))
        np.testing.assert_allclose(apart, before, atol=1e-9 if name == "y" else 2e-3)


def test_no_hand_rolls_so_far():
    trial, rig, _ = rolling_trial(76200, 0.02)
    degrees = replace(trial, channels=trial.channels | {ROLL: np.degrees(trial.channels[ROLL])})
    refused(r"column hand_roll: .* rad; expected radians, .* in degrees", remove_roll, degrees)
    refused("column hand_roll", read_trial, {"t": trial.t} | degrees.channels, rig)
    read = read_trial({"t": trial.t} | trial.channels, rig)
    np.testing.assert_allclose(read.channels["fy1"], remove_roll(trial).channels["fy1"])


def test_a_watcher_takes_the_roll_out_row_by_row():
    trial, rig, _ = rolling_trial(76200, 0.05)
    rolled, level = Watcher(scene()[1], rig), Watcher(scene()[1], rig)
    names, flat = (*CARTESIAN_CHANNELS, ROLL), remove_roll(trial)
    for k, t in enumerate(trial.t[:200]):
        rolled.update(t, [trial.channels[n][k] for n in names])
        level.update(t, [flat.channels[n][k] for n in CARTESIAN_CHANNELS])
    for (_, a), (_, b) in zip(rolled.filter.rows, level.filter.rows, strict=True):
        np.testing.assert_allclose(a[[0, 1, 4, 5, 6, 7, 10, 11]], b[[0, 1, 4, 5, 6, 7, 10, 11]], atol=1e-12)
