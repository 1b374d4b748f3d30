"""What changes within a sample: fast work is no irregular clock, and brief delays are told with care."""

from dataclasses import replace

import numpy as np
import pytest
from demo_recordings import RIG, TASK

from hmmseg.segmentation.align import align
from simgap.effects.sensing import _clock_rates
from simgap.gap.assemble import scatters
from simgap.gap.frame import CHANNELS, _struck, build
from simgap.gap.problem import fit, neutral, problem, residual_at, residual_of
from simgap.gap.residuals import fivepoint
from simgap.gap.sensor_noise import changes, kinks, of_a_kink, speed_jumps
from simgap.gap.simulated import performed, recorded
from simgap.world.operator import OperatorSettings
from simgap.world.properties import Block
from tests.simgap.test_gap_effects import performance, world_of

BLOCKS = {"block1": Block(0.5, 0.018, 0.016), "block2": Block(0.6, 0.026, 0.016)}
TWICE = OperatorSettings(pace=(1.8, 2.0))


def trials(effects, operator=None, rig=RIG):
    done = performed(TASK, rig, [BLOCKS] * 4, [31, 32, 33, 34], effects, operator)
    return [recorded(s, TASK, rig, effects) for s in done]


@pytest.fixture(scope="module")
def fast():
    given = problem(build(align(trials({}, TWICE), TASK, RIG)))
    return given, fit(given, (), neutral(given))


def test_fast_work_shows_no_irregular_clock_and_an_irregular_one_its_own_size(fast):
    given, healthy = fast
    (clock,) = scatters(given, healthy.residual, ["clock_jitter"])
    assert clock.value < 1.5e-3 or not clock.same
    rig = RIG.model_copy(update={"rate": 100.0})
    given = problem(build(align(trials({"clock_jitter": {"sd": 4e-3}}, rig=rig), TASK, rig)))
    assert given.frame.groups[0] > 2
    (clock,) = scatters(given, fit(given, (), neutral(given)).residual, ["clock_jitter"])
    assert clock.same and clock.value == pytest.approx(4e-3, rel=0.3)


def test_a_clocks_errors_move_residuals_by_their_unit(fast):
    """Monte Carlo: speeds and positions of a smooth motion, read at wrong times."""
    given, _ = fast
    world, there = given.frame.world, given.there
    t, rng, sd = np.asarray(world.t), np.random.default_rng(0), 2e-3

    def moved(at):  # both fingers swing, fast enough for speeds to differ between neighbours
        swing = 0.02 * np.sin(9 * at)[..., None] * np.array([1.0, 0.7, 1.0, 0.7])
        speed = 0.18 * np.cos(9 * at)[..., None] * np.array([1.0, 0.7, 1.0, 0.7])
        return world._replace(joints=swing, rates=speed, jointed=np.zeros(()))

    still = replace(given, frame=replace(given.frame, world=moved(t)))
    unit = _clock_rates(still) * np.sqrt(np.array(given.frame.groups))[:, None, None]
    drawn = [residual_of(given, moved(t + sd * rng.standard_normal(t.shape))) for _ in range(60)]
    change = np.zeros((60, *there.shape))
    change[:, there] = np.array(drawn) - residual_of(given, moved(t))
    for c in (CHANNELS.index("vx"), CHANNELS.index("vy")):
        mine = there[..., c]
        ratio = np.sqrt(np.mean(change[:, mine, c] ** 2, axis=0)) / (sd * unit[mine, c])
        assert np.quantile(ratio, [0.1, 0.5, 0.9]) == pytest.approx([0.87, 1.0, 1.13], abs=0.05)


@pytest.mark.parametrize(("channel", "phase", "most"), [("vx", 0, 1.3), ("vy", 0, 1.3), ("vx", 2, 1.3),
                                                        ("vy", 2, 1.3), ("fy", 2, 1.8)])  # fmt: skip
def test_fast_work_leaves_little_but_noise_away_from_contact_changes(fast, channel, phase, most):
    # Differences without their doubt leave 1.4 to 2.1 here, accelerations from three samples 2.5. Beside a
    # touchdown much more is left still (docs/gap.md).
    given, healthy = fast
    z, c = residual_at(given, (), healthy.u), CHANNELS.index(channel)
    world, arrays = given.frame.world, given.frame.arrays
    beside = np.abs(world.t[..., None] - world.events[:, None]).min(-1) < np.median(np.diff(world.t))
    mine = given.there[..., c] & (arrays.phase.argmax(-1) == phase) & ~beside
    assert (z[..., c][mine] ** 2).mean() < most


def test_five_samples_give_slopes_to_fourth_order():
    world = world_of(performance(400))
    t = np.asarray(world.t)
    found, three = fivepoint(world, np.asarray(t**4)[..., None])
    exact = 4 * t**3
    assert np.abs(found[..., 0] - exact)[:, 2:-2].max() < 1e-9 * np.abs(exact).max()
    assert np.abs(three[..., 0] - exact)[:, 2:-2].max() > 1e-6 * np.abs(exact).max()


def test_a_jump_of_speed_is_in_doubt_by_as_much_as_the_rule_is_off_and_noise_is_not():
    rng, step = np.random.default_rng(0), 0.05
    sd = np.full(4000, 3e-5)
    assert (speed_jumps(sd * rng.standard_normal(4000), sd, step, 1) > 0).mean() < 0.14  # largest of three
    t = step * np.arange(40)
    doubt = speed_jumps(0.2 * np.maximum(t - 0.975, 0.0), sd[:40], step, 1)
    assert doubt[19] > 0.005 and doubt[20] > 0.005 and not doubt[:16].any() and not doubt[24:].any()
    irregular = step * np.arange(400) + 0.004 * rng.standard_normal(400)
    assert (speed_jumps(0.1 * np.sin(irregular), sd[:400], step, 1) > 0).mean() < 0.25
    assert (speed_jumps(np.full(40, np.nan), sd[:40], step, 1) == 0).all()
    step, found = 0.05, []
    for when in np.linspace(0.95, 1.0, 21):
        t = step * np.arange(40)
        place, speed = np.maximum(t - when, 0.0), 1.0 * (t > when)
        rule = (speed[:-2] + 4 * speed[1:-1] + speed[2:]) / 6 - (place[2:] - place[:-2]) / (2 * step)
        found.append((np.sum(rule**2), np.sum(speed_jumps(place, np.full(40, 1e-9), step, 1) ** 2)))
    off, doubt = np.sqrt(np.mean(found, axis=0))
    assert doubt == pytest.approx(off, rel=0.15)


@pytest.mark.parametrize("group", [1, 4])
def test_the_doubt_of_a_kink_is_as_large_as_the_rules_are_off(group):
    """A jump of the acceleration, in the rule for speeds and in the slope of five of them."""
    step, found = 0.05, []
    for when in np.linspace(0.95, 1.0, 21):
        t = (step * (np.arange(40 * group) + 0.5) / group).reshape(40, group)
        ramp = np.maximum(t - when, 0.0)
        place, speed, rate = (z.mean(1) for z in (ramp**2 / 2, ramp, 1.0 * (t > when)))
        rule = (speed[:-2] + 4 * speed[1:-1] + speed[2:]) / 6 - (place[2:] - place[:-2]) / (2 * step)
        near, far = speed[3:-1] - speed[1:-3], speed[4:] - speed[:-4]
        slope = (8 * near - far) / (12 * step) - rate[2:-2]
        doubt = kinks(speed, np.full(40, 1e-12))
        found.append([np.sum(z**2) for z in (rule, slope, doubt)])
    rule, slope, doubt = np.sqrt(np.mean(found, axis=0))
    mean, difference = of_a_kink(group)
    assert mean * doubt == pytest.approx(rule, rel=0.15)
    assert difference * doubt / step == pytest.approx(slope, rel=0.15)


def test_noise_smooth_motion_and_pushes_have_no_kinks_and_touches_no_speeds():
    rng, t = np.random.default_rng(0), 0.05 * np.arange(4000)
    assert (kinks(1e-3 * rng.standard_normal(4000), np.full(4000, 1e-3)) > 0).mean() < 0.25  # largest of five
    assert kinks(0.1 * np.sin(3 * t), np.full(4000, 1e-3)).max() == 0
    place = np.where(np.arange(40) < 20, 0.0, 2e-3)
    push = changes(place, np.full(40, 2e-5))
    assert push[19] == push[20] == pytest.approx(2e-3, rel=0.05) and np.count_nonzero(push) == 2
    force = np.zeros((20, 4))
    force[8:14, 0] = 1.0
    struck = np.flatnonzero(_struck(force, np.full(20, 0.01)))
    assert struck.tolist() == [6, 7, 8, 9, 12, 13, 14, 15]
