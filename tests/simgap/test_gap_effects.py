"""Effects: gradients, neutrality, planted ones taken out again; one is a file, named nowhere else."""

import ast
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from jax.tree_util import tree_leaves
from simgap_scenes import HAND
from simgap_swing import Swing, log

import simgap
from experiments.generic_ensembles import TASK, ensemble
from hmmseg.hand.kinematics import inverse
from hmmseg.io.trial import Trial
from simgap import channels, effects
from simgap.effects import catalogue
from simgap.effects.base import Performance, World, flat, tips, turning_compliance
from simgap.gap.problem import STEP
from simgap.gap.residuals import contact
from simgap.generic import effects as of_ensembles
from simgap.generic.diagnose import diagnose
from simgap.generic.trials import align
from simgap.play.world import felt_effects
from simgap.robot_effects import candidates
from simgap.robot_effects.base import Setting
from simgap.simulators.user import checked

CONTRACT = """
force_bias force_drift force_gain force_crosstalk sensor_rotation force_lag force_lowpass
quantisation joint_offset link_length backlash clock_jitter fingertip_compliance fingertip_creep
fingertip_mass grip_slip object_inertia offcentre_mass table_tilt table_compliance cable_force
viscous_drag structural_vibration contact_impact hand_roll actual
"""
RNG = np.random.default_rng(0)
PLANTED = {"force_bias": {"fx1": 0.1, "fy1": -0.05, "fx2": 0.02, "fy2": 0.07},
           "force_drift": {"fx1": 0.01, "fy1": 0.0, "fx2": -0.02, "fy2": 0.005, "bend": 0.2},
           "force_gain": {"gain": 0.08}, "force_crosstalk": {"fy_from_fx": 0.06, "fx_from_fy": -0.03},
           "sensor_rotation": {"angle1": 0.05, "angle2": -0.04}, "viscous_drag": {"coefficient": 0.7},
           "fingertip_mass": {"mass": 0.012},
           "contact_impact": {"impulse": 0.02, "length": 0.06}}  # fmt: skip

KINEMATIC = {"joint_offset": {"q11": 0.01, "q12": -0.005, "q21": 0.0, "q22": 0.02},
             "link_length": {"scale": 0.02}}  # fmt: skip


def performance(n: int = 400) -> Performance:
    t = np.arange(n) * 5e-3
    x, y = 0.12 + 0.02 * np.sin(3 * t), 0.03 + 0.01 * np.cos(2 * t)
    position = np.stack([np.stack([x - 0.01, y], 1), np.stack([x + 0.01, y], 1)], 1)
    velocity, grip = np.gradient(position, t, axis=0), 2.0 / (1 + np.exp(-(t - 1.0) / 0.03))
    force = np.stack([np.stack([grip, 0.2 * grip], 1), np.stack([-grip, 0.25 * grip], 1)], 1)
    held = (t > 1.2).astype(float)
    load, width = 0.5 * held, np.where(held > 0, 0.02, 1.0)
    return Performance(t, position, velocity, force, np.array([1.0, 1.2, 1.6, 1.9]), HAND, load, width)


def world_of(p: Performance) -> World:
    """The world that the nominal hand records of a performance, every tenth sample."""
    k = slice(None, None, 10)
    joints = np.concatenate([inverse(HAND.finger(i), i, p.position[k, i - 1]) for i in (1, 2)], 1)
    rates, held = np.gradient(joints, p.t[k], axis=0), (p.t[k] > 1.0).astype(float)
    carry = ((p.t[k] > 1.2) & (p.t[k] < 1.6)).astype(float)
    one, zero = np.ones(()), np.zeros(())
    return World(t=p.t[k][None], joints=joints[None], rates=rates[None], force=flat(p)[k][None],
                 load=np.zeros((1, held.size, 4)), base=np.array([0.05, 0.17, 0.21, 0.17]),
                 length=np.full(4, 0.12), jointed=one, gravity=9.81 * one, link=np.ones(4),
                 give_normal=np.full(2, 1 / 4000), give_shear=np.full(2, 1 / 2500), delay=np.zeros(4),
                 smoothing=np.zeros(4), creep=zero, creep_time=one, tilt=zero, give_support=zero,
                 support_time=zero, inertia=one, couple=zero, loudness=np.ones((1, held.size, 4)),
                 ring=np.array([1.0, 0.05, 0.0]), slip=np.zeros((1, held.size)), modes=np.zeros(6),
                 free=1 - held[None], ground=(held - carry)[None], carry=carry[None],
                 events=p.events[None])  # fmt: skip


def test_every_name_of_the_contract_is_an_effect():
    assert set(catalogue()) == {*CONTRACT.split()}


@pytest.mark.parametrize("name", sorted(n for n, e in catalogue().items() if e.correct is not None))
def test_an_effect_that_is_off_changes_nothing_and_is_finite_where_a_fit_begins(name):
    effect, world = catalogue()[name], world_of(performance())
    out = effect.correct(world, {p.name: p.nominal for p in effect.parameters.values()}, 0.0)
    for before, after, field in zip(world, out, World._fields, strict=True):
        if field not in ("creep_time", "ring", "dead_band"):  # of no width they say nothing
            np.testing.assert_allclose(after, before, atol=1e-12, err_msg=field)
    for which in (0, -1):
        start = {p.name: p.starts[which] if p.starts else p.nominal for p in effect.parameters.values()}
        steps = [{**start, p.name: p.value(p.coordinate(start[p.name]) + STEP)}
                 for p in effect.parameters.values()]  # fmt: skip
        assert all(np.isfinite(z).all() for v in (start, *steps)
                   for z in tree_leaves(effect.correct(world, v, 1.0)))  # fmt: skip


@pytest.mark.parametrize("name", [*PLANTED, *KINEMATIC])
def test_what_apply_puts_in_correct_takes_out(name):
    truth, values = performance(), (PLANTED | KINEMATIC)[name]
    effect = catalogue()[name]
    recorded = world_of(effect.apply(truth, values, np.random.default_rng(0)))
    out = effect.correct(recorded, values, 1.0)
    if name in KINEMATIC:
        place = truth.position[::10].reshape(-1, 4)
        np.testing.assert_allclose(tips(out)[0][0], place, atol=1e-9)
        assert np.abs(tips(recorded)[0][0] - place).max() > 1e-4
        return
    before = np.abs(recorded.force - world_of(truth).force).max()
    assert before > 0.01
    tolerance = 0.15 * before if name == "fingertip_mass" else 0.05 * before  # accelerations are differences
    np.testing.assert_allclose(contact(out), world_of(truth).force, atol=tolerance)


def test_a_mass_off_the_middle_turns_the_block_until_moments_balance():
    truth, off = performance(), 0.004
    out = catalogue()["offcentre_mass"].apply(truth, {"offset": off}, np.random.default_rng(0))
    pad, force, up = truth.rig.fingertip, out.force, truth.carried > 0
    np.testing.assert_array_equal(out.position, truth.position)
    np.testing.assert_array_equal(force[~up], truth.force[~up])
    np.testing.assert_allclose(force.sum(1), truth.force.sum(1), atol=1e-12)
    sheared = (force - truth.force)[:, 1, 1] - (force - truth.force)[:, 0, 1]
    turn = -sheared / pad.shear_stiffness / truth.width  # tips stay: what pads shear more, the block turns
    apart = out.position[:, 1, 1] - out.position[:, 0, 1]
    apart = apart - (force[:, 1, 1] - force[:, 0, 1]) / pad.shear_stiffness
    moment = (force[:, 0, 0] - force[:, 1, 0]) / 2 * apart
    moment = moment + truth.width / 2 * (force[:, 1, 1] - force[:, 0, 1]) - truth.carried * off
    expected = turning_compliance(pad.normal_stiffness) * moment
    assert np.abs(turn[up]).max() > 1e-3
    np.testing.assert_allclose(turn[up], expected[up], rtol=1e-9)


def test_what_crosstalk_makes_of_noise_is_known():
    # Or a turn beside a crosstalk, which is a turn and a gain, would win by making all noise smaller.
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.01, (1, 20_000, 4))
    world = world_of(performance())._replace(force=np.asarray(noise), loudness=np.ones_like(noise))
    values = {"fy_from_fx": 0.2, "fx_from_fy": -0.15}
    out = catalogue()["force_crosstalk"].correct(world, values, 1.0)
    one, two = out.force[..., :2], out.force[..., 2:]
    seen = np.concatenate([(one + two) / 2**0.5, (one - two) / 2**0.5], -1) * out.loudness
    np.testing.assert_allclose(seen.std(axis=(0, 1)), 0.01, rtol=0.02)


def test_what_is_nearest_to_the_recorded_number_is_put_in_last_and_taken_out_first():
    truth, drag, lag = performance(), catalogue()["viscous_drag"], catalogue()["force_lag"]
    late = lag.apply(drag.apply(truth, {"coefficient": 5.0}, RNG), {"delay": 0.1}, RNG)
    world = world_of(late)
    for effect, values in ((lag, {"delay": 0.1}), (drag, {"coefficient": 5.0})):
        world = effect.correct(world, values, 1.0)
    off = np.abs(contact(world) - world_of(truth).force)[:, 3:-15]
    put_in = np.abs(world_of(late).force - world_of(truth).force)[:, 3:-15]
    assert off.max() < 0.1 * put_in.max()
    gain, bias = catalogue()["force_gain"], catalogue()["force_bias"]
    values = dict.fromkeys(("fx1", "fy1", "fx2", "fy2"), 0.1)
    recorded = bias.apply(gain.apply(truth, {"gain": 0.5}, RNG), values, RNG)
    np.testing.assert_allclose(flat(recorded), 1.5 * flat(truth) + 0.1)
    assert bias.stage < gain.stage  # what is nearest to the recorded number is taken out first
    world = world_of(recorded)
    for effect, v in ((bias, values), (gain, {"gain": 0.5})):
        world = effect.correct(world, v, 1.0)
    np.testing.assert_allclose(contact(world), world_of(truth).force, atol=1e-12)


def test_pads_that_carry_a_block_hold_it_and_quantised_forces_lie_on_the_lattice():
    # Friction far too low to hang a block from would let all of its heights go free.
    world, slip = world_of(performance()), catalogue()["grip_slip"]
    low, carried = slip.correct(world, {"mu": 0.08}, 1.0), np.asarray(world.carry)
    assert carried.sum() > 3 and (np.asarray(low.slip) * carried).sum() <= 0.2 * carried.sum()
    force = catalogue()["quantisation"].finish(np.array([0.013, -0.049, 1.234]), {"step": 0.02})
    np.testing.assert_allclose(force, [0.02, -0.04, 1.24])


ROOT = Path(simgap.__file__).parent
# The comparison with given trials and robots have effects of their own, some of the same names.
CATALOGUES = {ROOT / "generic/effects.py", ROOT / "channels/drives.py"}


@pytest.fixture
def step(tmp_path, monkeypatch):
    page = (ROOT.parent / "docs/your_effect.md").read_text()
    (tmp_path / "step.py").write_text(re.findall(r"```python\n(.*?)```", page, re.DOTALL)[0])
    caches = (channels.channel_effects, effects.catalogue, of_ensembles.effects)
    monkeypatch.setattr(channels, "__path__", [*channels.__path__, str(tmp_path)])
    for cache in caches:
        cache.cache_clear()
    yield channels.channel_effects()["step"]
    sys.modules.pop("simgap.channels.step", None)
    for cache in caches:
        cache.cache_clear()


def test_it_is_a_candidate_everywhere_and_taken_out_of_forces_as_it_was_put_in(step):
    mine = effects.catalogue()["force_step"]
    assert list(mine.parameters) == ["fx1", "fy1", "fx2", "fy2"] and "force_step" in felt_effects()
    assert mine.parameters["fx1"].unit == "N" and mine.parameters["fx1"].sd == pytest.approx(0.09)
    logs = [log(0), log(1)]
    robots = candidates(Setting(checked(Swing(), "Swing"), logs))["readout:angle.step"]
    sd = np.concatenate([r["angle"] for r in logs]).std()
    assert robots.parameters["step"].sd == pytest.approx(0.03 * sd)
    mine, t = effects.catalogue()["force_step"], np.linspace(0, 4, 60)
    truth = np.random.default_rng(0).standard_normal((60, 4))
    values = {"fx1": 0.1, "fy1": -0.2, "fx2": 0.0, "fy2": 0.3}
    made = performance()._replace(t=t, force=truth.reshape(-1, 2, 2))
    put = mine.apply(made, values, RNG).force.reshape(-1, 4)
    np.testing.assert_allclose(put - truth, np.outer(t > 2, list(values.values())), atol=1e-12)
    out = mine.correct(world_of(performance())._replace(t=t[None], force=put[None]), values, 1.0)
    np.testing.assert_allclose(out.force[0], truth, atol=1e-12)


def test_it_is_named_in_given_trials(step):
    rng = np.random.default_rng(3)
    real, first = ensemble(rng, 6)
    sim, second = ensemble(rng, 6, name="sim")
    changed = [Trial(t.file, t.t, t.channels | {"fa": step.read(t.t, t.channels["fa"], {"step": 1.0})})
               for t in real]  # fmt: skip
    body = diagnose(align(changed, sim, TASK, boundaries=first | second)).body
    assert body["causes"] == ["force_step"]
    assert body["effects"]["force_step"]["parameters"]["fa"]["mean"] == pytest.approx(1.0, rel=0.1)


def named_in(path: Path, names: set[str]) -> set[str]:
    """Effects whose names stand as strings in the code of a file, alone or before what follows a dot."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    texts = (n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str))
    found = [text for text in texts if not text.endswith(".toml")]  # actual.toml is a file
    return {text.split(".")[0].split("/")[0] for text in found} & names


def test_no_file_but_those_that_define_effects_names_one():
    names, listed = set(catalogue()), {}
    for path in sorted(ROOT.rglob("*.py")):
        # What an effect is taken for, and its own keys, are said where it is defined.
        own = path.parent == ROOT / "effects" and " = HandEffect(\n" in path.read_text(encoding="utf-8")
        others = set() if own or path in CATALOGUES else named_in(path, names)
        if others:
            listed[str(path.relative_to(ROOT))] = others
    assert listed == {}
