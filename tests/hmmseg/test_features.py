"""Features: averages of fine samples, noise that is learned, accelerations."""

import numpy as np
import pytest

from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import Fingertip, Noise, Rig
from hmmseg.io.trial import Trial
from hmmseg.segmentation.emissions import acceleration, features, noise_sd, thin

CHANNELS = ("x1", "y1", "vx1", "vy1", "fx1", "fy1", "x2", "y2", "vx2", "vy2", "fx2", "fy2")


def made_signals(t, rng, sd=0.1):
    columns = {name: rng.normal(size=t.size) * sd for name in CHANNELS}
    spread = {name: np.full(t.size, sd) for name in ("sd_x", "sd_y", "sd_vx", "sd_vy")}
    return Signals(t=t, **columns, **spread, sd_force=sd)


def test_noise_is_found_beneath_a_smooth_signal():
    rng, t = np.random.default_rng(0), np.arange(2000) * 0.05
    noise = noise_sd(np.sin(t) + 0.01 * rng.normal(size=t.size))
    assert noise == pytest.approx(0.01, rel=0.1)
    stepped = np.sin(t) + 0.01 * rng.normal(size=t.size) + 5.0 * (t > 40) + 5.0 * (t > 70)
    assert noise_sd(stepped) == pytest.approx(0.01, rel=0.1)


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


def test_a_short_window_reads_the_first_samples_of_each_group():
    signals = made_signals(np.arange(4000) / 1000, np.random.default_rng(1))
    read = thin(signals, window=6e-3)
    np.testing.assert_allclose(read.fx1, signals.fx1.reshape(160, 25)[:, :6].mean(axis=1))
    assert read.sd_force == pytest.approx(0.1 / np.sqrt(6))


def test_thinning_skips_missing_values():
    t = np.arange(8) / 80
    signals = made_signals(t, np.random.default_rng(2))
    signals.fy1[[0, 2, 3]] = np.nan
    thinned = thin(signals)
    np.testing.assert_allclose(thinned.fy1[0], signals.fy1[1])
    assert np.isnan(thinned.fy1[1])
    np.testing.assert_allclose(thinned.fy1[2:], signals.fy1[4:].reshape(2, 2).mean(axis=1))


def test_acceleration_skips_missing_samples():
    t = np.array([0.0, 0.1, 0.25, 0.3, 0.5, 0.6])
    velocity = 3 * t**2 + 1
    np.testing.assert_allclose(acceleration(t, velocity)[1:-1], 6 * t[1:-1], rtol=1e-12)
    velocity[2] = np.nan
    found = acceleration(t, velocity)
    assert np.isnan(found[2])
    np.testing.assert_allclose(found[[1, 3, 4]], 6 * t[[1, 3, 4]], rtol=1e-12)
    assert np.isnan(acceleration(t[:2], velocity[:2])).all()


def test_noise_of_means_and_distances():
    """Mean and distance of two fingers with independent noise s: s / sqrt(2) and s sqrt(2)."""
    rig = Rig(noise=Noise(position=3e-5, velocity=4e-3, force=0.01), fingertip=Fingertip())
    t = np.arange(40) * 0.05
    trial = Trial("made.csv", t, {name: np.sin(t) for name in CHANNELS})
    f = features(task_space(trial, rig), rig)
    np.testing.assert_allclose(f.sd_y, 3e-5 / np.sqrt(2))
    np.testing.assert_allclose(f.sd_d, 3e-5 * np.sqrt(2))
    np.testing.assert_allclose(f.sd_vx, 4e-3 / np.sqrt(2))
