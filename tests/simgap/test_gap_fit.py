"""The fit on recordings: healthy ones are noise, a planted effect is found with its parameters."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from demo_recordings import RECORDINGS, recorded

from hmmseg.errors import InputError
from hmmseg.jaxconfig import double_precision
from hmmseg.segmentation.align import align
from simgap.attribution.posterior import fitted, forms
from simgap.attribution.problem import cosines
from simgap.effects import effect_named
from simgap.gap import diagnose
from simgap.gap.assemble import gap_of, rows_of, scatters, together
from simgap.gap.frame import CHANNELS, build
from simgap.gap.nuisances import with_nuisances
from simgap.gap.problem import derivatives, fit, neutral, problem, slots
from simgap.gap.search import search


def read(name):
    return build(align(*recorded(name, 2)))


def own(given, found, name):
    slot = next(s for s in slots(given.num_common)[0] if s.effect.name == name)
    every = slot.effect.parameters.values()
    return {p.name: float(p.value(found.u[slot.start + j])) for j, p in enumerate(every)}


@pytest.fixture(scope="module")
def healthy():
    given = problem(read("none_1"))
    return given, double_precision(fit)(given, (), neutral(given))


@double_precision
def test_a_healthy_recording_is_noise(healthy):
    _, found = healthy
    assert 0.7 < np.mean(found.residual**2) < 1.15


@double_precision
def test_a_force_bias_is_recovered():
    given = problem(read("force_bias_1"))
    labels = json.loads((RECORDINGS / "labels.json").read_text())
    truth = next(e for e in labels if e["case"] == "force_bias_1")["params"]["bias"]
    plain, biased = (fit(given, e, neutral(given)) for e in ((), ("force_bias",)))
    np.testing.assert_allclose(list(own(given, biased, "force_bias").values()), truth, atol=0.004)
    assert plain.cost - biased.cost > 1000


@double_precision
def test_a_gain_cannot_win_by_scaling_the_noise(healthy):
    given, found = healthy
    scaled = fit(given, ("force_gain",), neutral(given))
    assert found.cost - scaled.cost < 8


@double_precision
def test_a_form_has_its_own_parameters_free(healthy):
    given, _ = healthy
    one = fit(given, ("force_gain/1",), neutral(given), steps=1)
    values = own(given, one, "force_gain")
    assert values["gain"] == 0 and values["fx1"] == 0 and values["finger1"] != 0


@double_precision
def test_a_joint_fit_is_the_sum_of_its_parts_where_it_was_linearised(healthy):
    given, plain = healthy
    names = ("force_bias", "table_tilt")
    joint = fit(given, names, neutral(given))
    gap = together(given, gap_of(given, plain, []), plain, joint)
    assert [c.name for c in gap.candidates] == list(names)
    left = gap.residual - gap.nuisance[:, : given.num_common] @ joint.u[: given.num_common]
    left = left - sum(c.shift for c in gap.candidates)
    np.testing.assert_allclose(left, joint.residual, atol=1e-8)


@double_precision
def test_the_better_of_two_joint_fits_counts(healthy, monkeypatch):
    given, plain = healthy
    alone, tilted = (fit(given, (e,), neutral(given) + 0.1, steps=0) for e in ("force_bias", "table_tilt"))
    f = forms(gap_of(given, plain, [alone, tilted]))
    best, starts = fitted(f, (0, 1)), []

    def recorded_start(_, keys, u):
        starts.append(u)
        return replace(alone, effects=keys, u=u, cost=-float(len(starts)))

    monkeypatch.setattr(diagnose, "fit", recorded_start)
    found = SimpleNamespace(problem=given, healthy=plain)
    joint, own = diagnose._leading(found, f, best), alone.columns[given.num_common :]
    assert joint is not None and joint.u is starts[1]
    np.testing.assert_allclose(starts[0][own], f.gap.candidates[0].at)
    np.testing.assert_allclose(starts[1][: given.num_common], best.x[: given.num_common])
    assert np.abs(starts[1][own]).max() < 0.05  # a healthy hand's


@double_precision
def test_a_scatter_is_as_large_as_it_was_before_nuisances_took_of_it(healthy):
    """Kept variances, against the dense projection of independent coefficients."""
    given = with_nuisances(healthy[0])
    rows, rng = rows_of(given), np.random.default_rng(0)
    variance = np.where(rows.channel == CHANNELS.index("offset"), 9.0, 0.0)
    columns = cosines(rows, given.nuisances.columns)[0]
    drawn = np.sqrt(variance)[:, None] * rng.standard_normal((variance.size, 400))
    left = drawn - columns @ np.linalg.solve(np.eye(columns.shape[1]) + columns.T @ columns,
                                             columns.T @ drawn)  # fmt: skip
    mine, kept = variance > 0, given.nuisances.kept(rows, variance)
    assert kept[mine].sum() == pytest.approx(np.square(left[mine]).mean(1).sum(), rel=0.02)
    assert kept[mine].min() < 0.9 * 9.0 and (kept[~mine] == 0).all()


@double_precision
def test_what_the_rig_admits_is_a_nuisance():
    frame = read("none_1")
    rig = frame.rig.model_copy(
        update={"systematic": frame.rig.systematic.model_copy(update={"force_bias": (0.02, 0.0, 0.0, 0.01)})}
    )
    given = with_nuisances(problem(replace(frame, rig=rig)))
    k = given.num_common
    push = derivatives(given, ("force_bias",), neutral(given))[:, k:]
    np.testing.assert_allclose(given.nuisances.columns[:, :2], -push[:, [0, 3]] * [0.2, 0.1], rtol=1e-6)


@double_precision
def test_quantisation_is_seen_and_not_imagined(healthy):
    given, found = healthy
    assert not scatters(given, found.residual, ["quantisation"])
    finish = effect_named("quantisation").finish
    assert finish is not None
    rounded = tuple(finish(force, {"step": 0.04}) for force in given.frame.forces)
    coarse = replace(given, frame=replace(given.frame, forces=rounded))
    (seen,) = scatters(coarse, found.residual, ["quantisation"])
    assert seen.value == pytest.approx(0.04, rel=1e-3) and seen.known > 100


@double_precision
@pytest.mark.parametrize("broken", [1, 2])
def test_a_trial_without_one_of_its_channels_is_left_out(broken):
    trials, task, rig = recorded("none_1", 2)
    mute = [replace(t, channels=t.channels | {"q12": np.full(t.t.size, np.nan)}) if k < broken else t
            for k, t in enumerate(trials)]  # fmt: skip
    aligned = align(mute, task, rig)
    assert [t.segmentation.complete for t in aligned.trials] == [False] * broken + [True] * (2 - broken)
    if broken == 2:
        with pytest.raises(InputError, match="trial_01"):
            search(aligned)
    else:
        assert [t.name for t in search(aligned).trials] == ["trial_02.csv"]
