"""Whole segmentations against the truth: recordings, and simulated trials under hard conditions."""

import itertools
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.recordings import read_case
from experiments.worlds import Cell, World, scene, simulated_cases, trials_of
from hmmseg.io.rig import FORCE_CHANNELS, Fingertip, Noise, Rig
from hmmseg.io.trial import Trial
from hmmseg.segmentation.align import align, segment

RECORDINGS = Path(__file__).resolve().parents[2] / "recordings"
NEAR = 0.05  # s


def residuals(trials, truth, task, rig):
    """Boundary residuals [s] (num_trials, num_boundaries), spans checked for sense."""
    found = segment(trials, task, rig)
    out = []
    for segmentation, trial, times in zip(found, trials, truth, strict=True):
        assert segmentation.complete
        spans = segmentation.spans
        assert len(spans) == 9 and spans[0].start == trial.t[0] and spans[-1].end == trial.t[-1]
        for a, b in itertools.pairwise(spans):
            assert a.end == b.start and a.end_90 == b.start_90 and a.end_sd == b.start_sd
            assert a.end_90[0] <= a.end <= a.end_90[1] and a.end_sd > 0
        out.append([span.start for span in spans[1:]] - np.asarray(times))
    return np.array(out)


def simulated(rate, trials=1, seed=20_950):
    case = simulated_cases(1, trials=trials, seed=seed, rate=rate)[0]
    return list(case.trials), [np.array(t) for t in case.truth], case.task, case.rig


def cartesian(case):
    """The first trial of a case as a hand without joints and velocities has it."""
    signals, names = case.signals[0], ("x1", "y1", "fx1", "fy1", "x2", "y2", "fx2", "fy2")
    noise = Noise(position=2.5e-5, velocity=4e-3, force=0.012)
    trial = Trial("cartesian.csv", signals.t, {name: getattr(signals, name) for name in names})
    return [trial], Rig(rate=20.0, fingertip=case.rig.fingertip, noise=noise)


HANDS = {"as stated": lambda case: (list(case.trials[:2]), case.rig),
         "noise unstated": lambda case: (list(case.trials[:2]),
                                         case.rig.model_copy(update={"noise": Noise()})),
         "rigid pads": lambda case: (list(case.trials[:2]),
                                     case.rig.model_copy(update={"fingertip": Fingertip()})),
         "Cartesian": cartesian}  # fmt: skip


@pytest.mark.parametrize("hand", HANDS)
def test_recordings_are_segmented_within_50_ms(hand):
    case = read_case(RECORDINGS / "none_2")
    trials, rig = HANDS[hand](case)
    found = residuals(trials, case.truth[: len(trials)], case.task, rig)
    assert np.abs(found).max() < NEAR and np.median(np.abs(found)) < 0.015


@pytest.mark.parametrize("rate", [10.0, 100.0, 1000.0])
def test_any_rate_from_10_hz_to_1_khz(rate):
    trials, truth, task, rig = simulated(rate)
    found = residuals(trials, truth, task, rig)
    assert np.abs(found).max() < (0.1 if rate == 10.0 else NEAR)  # one sample of 10 Hz is 100 ms
    assert np.median(np.abs(found)) < 0.015


def lossy(trial, rng, share=0.1):
    channels = {k: np.where(rng.uniform(size=v.size) < share, np.nan, v) for k, v in trial.channels.items()}
    return replace(trial, channels=channels)


def irregular(trial, rng, share=0.25):
    keep = np.sort(rng.choice(trial.t.size, size=int((1 - share) * trial.t.size), replace=False))
    keep = np.union1d(keep, [0, trial.t.size - 1])
    return replace(trial, t=trial.t[keep], channels={k: v[keep] for k, v in trial.channels.items()})


@pytest.mark.parametrize("change", [lossy, irregular])
def test_missing_samples_and_irregular_times(change):
    trials, truth, task, rig = simulated(50.0)
    found = residuals([change(t, np.random.default_rng(0)) for t in trials], truth, task, rig)
    assert np.abs(found).max() < NEAR


@pytest.mark.parametrize("start", [-0.2, 0.1])
def test_forces_missing_for_half_a_second_leave_changes_to_positions(start):
    (trial,), truth, task, rig = simulated(100.0)
    since = trial.t[:, None] - truth[0][::3] - start  # of a touch, a release and a set-down
    lost = ((since > 0) & (since < 0.5)).any(axis=1)
    channels = trial.channels | {f: np.where(lost, np.nan, trial.channels[f]) for f in FORCE_CHANNELS}
    assert np.abs(residuals([replace(trial, channels=channels)], truth, task, rig)).max() < NEAR


@pytest.mark.parametrize("block", ["block1", "block2"])
def test_an_open_hand_that_waits_as_wide_as_a_block_holds_none(block):
    """As grippers do that open to round numbers; nothing presses on its fingers."""
    case = read_case(RECORDINGS / "none_1")
    (trial,), rig = cartesian(case)
    now, rng = (trial.t >= 0.6) & (trial.t < 1.4), np.random.default_rng(0)
    half = tomllib.loads((RECORDINGS / "none_1" / "actual.toml").read_text())[block]["width"]["value"] / 2
    c, n = dict(trial.channels), int(np.argmax(now))
    middle = (c["x1"][n] + c["x2"][n]) / 2
    for name, place in (("x1", middle - half), ("x2", middle + half), ("y1", c["y1"][n]), ("y2", c["y2"][n])):
        c[name] = np.where(now, place + rng.normal(0, 2.5e-5, now.size), c[name])
    found = residuals([replace(trial, channels=c)], case.truth[:1], case.task, rig)
    assert np.abs(found).max() < NEAR


def test_pooling_shares_parameters_and_keeps_trials_apart():
    case = read_case(RECORDINGS / "none_1")
    together = align(case.trials, case.task, case.rig)
    turned = align(case.trials[::-1], case.task, case.rig)
    for a, b in zip(together.trials, turned.trials[::-1], strict=True):
        assert a.segmentation.file == b.segmentation.file
        ends = [[s.end for s in x.segmentation.spans] for x in (a, b)]
        np.testing.assert_allclose(*ends, atol=1e-4)
        assert a.segmentation.log_evidence == pytest.approx(b.segmentation.log_evidence, abs=0.5)


def test_the_later_of_two_touches_is_dated_wherever_the_first_has_pushed_the_block():
    """At 20 Hz with a finger up to 100 ms late: two of three held by where it stands later."""
    _, task = scene()
    held, off = [], []
    for judged in trials_of(World("", untidy="late finger"), range(78100, 78108)):
        (found,) = segment([judged.trial], task, judged.rig)
        for span, t in zip(found.spans[1::4], judged.boundaries[::4], strict=False):
            held.append(span.start_90[0] <= t <= span.start_90[1])
            off.append(span.start - t)
    assert np.mean(held) > 0.85 and np.median(np.abs(off)) < 5e-3


def test_at_high_rates_a_block_has_not_moved_yet_as_the_later_finger_touches():
    _, task = scene()
    off = []
    for judged in trials_of(World("", Cell(rate=1000.0)), range(78100, 78104)):
        (found,) = segment([judged.trial], task, judged.rig)
        off += [span.start - t for span, t in zip(found.spans[1::4], judged.boundaries[::4], strict=False)]
    assert abs(np.median(off)) < 1.3e-3  # 1.6 ms early where it is taken to follow at once
