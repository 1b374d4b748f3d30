"""The worlds of `make calibrate`: what differs is what is said to, and coverages count right."""

import numpy as np
import pytest

from experiments.calibration_worlds import clustered, summary
from experiments.sbc import DRAWS, design_of, drawn
from experiments.sbc import summary as rank_summary
from experiments.worlds import BIAS, WORLDS, _coloured, _stated, scene, task_of
from hmmseg.contact.decompose import decompose
from hmmseg.io.trial import Trial


@pytest.mark.parametrize("blocks, moves", [(1, 1), (2, 2), (3, 3), (6, 6)])
def test_a_tower_of_any_height_is_reversed(blocks, moves):
    task = task_of(blocks)
    assert len(task.objects) == blocks and len(task.performed) == moves
    known = decompose(task).properties
    assert all(entry["weight"].reason is None for entry in known.values())


def test_coloured_noise_keeps_its_variance_and_has_its_correlation():
    rng, t = np.random.default_rng(0), np.arange(40_000) / 20.0
    clean = Trial("x.csv", t, {"fx1": np.sin(t)})
    noisy = Trial("x.csv", t, {"fx1": np.sin(t) + 0.1 * rng.normal(size=t.size)})
    noise = _coloured(noisy, clean, 0.5).channels["fx1"] - np.sin(t)
    assert noise.std() == pytest.approx(0.1, rel=0.03)
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(0.5, abs=0.03)


def test_the_estimator_is_told_what_the_row_says():
    rig = scene()[0]
    half, double = (_stated(WORLDS[f"noise stated x{k}"], rig).noise.force for k in ("0.5", "2"))
    assert (half, double) == pytest.approx((0.5 * rig.noise.force, 2 * rig.noise.force))
    assert _stated(WORLDS["bias twice that"], rig).systematic.force_bias == (BIAS,) * 4
    assert not any(_stated(WORLDS["pads 30 % off, untold"], rig).systematic.pad_stiffness)


def test_coverage_with_replicates_as_clusters():
    share, error = clustered([np.ones(6), np.zeros(6), np.ones(6), np.ones(6)])
    assert share == 0.75 and error == pytest.approx(np.std([0.25, -0.75, 0.25, 0.25], ddof=1) / 2)
    share, error = clustered([np.ones(6)] * 8)
    assert share == 1.0 and 0.02 < error < 0.05  # 48 of 48 do not prove a coverage of 100 %
    assert clustered([np.array([])]) == (None, None)
    only = {"of": "a.weight", "share": 0.01, "z": 1.0, "rank": 0.9}
    scored = [{"properties": [only], "reach_90": [0.5],
               "held_90": [1.0, 0.0], "boundaries": [0.01, 0.03], "misfits": 0,
               "trials": 1, "sampler": "emcee"}] * 2  # fmt: skip
    row = summary(scored)
    assert row["coverage_68"] == 0.0 and row["coverage_95"] == 1.0 and row["coverage_90"] == 0.5
    assert row["weight"]["z_rms"] == 1.0 and row["boundary_median"] == pytest.approx(0.02)


def test_drawn_data_are_of_the_design_they_are_drawn_for():
    rng = np.random.default_rng(1)
    design, true = drawn(design_of(3, 4, rng), rng)
    means = ~design.slope
    residual = (design.mean - design.coefficients @ true)[means] / np.sqrt(design.variance[means])
    assert true.shape == (9,) and (true > 0).all() and np.isfinite(design.mean).all()
    assert np.median(np.abs(residual)) < 20  # model error is a few times the sensors'
    uniform = rank_summary(np.tile(np.arange(DRAWS + 1), 10))
    assert uniform["p_value"] > 0.999 and uniform["coverage_95"] == pytest.approx(0.95, abs=0.011)
    assert rank_summary(np.zeros(1000, int))["p_value"] < 1e-6
