"""What is published: scores against hand-made truths, results and tables as pinned, constants."""

import copy
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

import experiments.constants as table
from experiments import scoring
from experiments.blind_check.judge import judge_case
from experiments.blind_check.scene import TASKS
from experiments.blind_check.score import calibration, figures
from experiments.blind_check.tables import fresh
from experiments.calibration import Estimates, summarise_estimates
from experiments.calibration_worlds import clustered, summary
from experiments.gap_drawn import outcome
from experiments.golden import KINDS, differences, folders, read, rounded
from experiments.recordings import list_cases, read_case
from experiments.saving import commit_of, save
from experiments.sbc import DRAWS, design_of, drawn
from experiments.sbc import summary as rank_summary
from experiments.score_recordings import METHODS, score_case, summarise
from experiments.worlds import BIAS, WORLDS, Deviations, _coloured, _stated, deviated, scene, simulated_cases
from experiments.write_tables import TABLES, fill
from hmmseg.contact.decompose import subtasks
from hmmseg.hand.signals import task_space
from hmmseg.io.task import BlockTask, Move
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import Segmentation, Span

ROOT = Path(__file__).parents[2]


def test_tables_are_filled_between_markers_and_no_spent_blind_set_is_a_result(monkeypatch):
    text = "a\n<!-- x -->\nold\n<!-- /x -->\nb\n<!-- y -->\n<!-- /y -->\n"
    once = fill(text, "x", "| new \\1 |")
    assert once == "a\n<!-- x -->\n\n| new \\1 |\n\n<!-- /x -->\nb\n<!-- y -->\n<!-- /y -->\n"
    assert fill(once, "x", "| new \\1 |") == once
    refused("no markers <!-- z -->", fill, text, "z", "table", error=ValueError)
    seals = {"blind_check": {"seal": {"sha256": "a"}}, "blind_sets": {"sets": [{"seal": "a"}]}}
    monkeypatch.setattr("experiments.blind_check.tables.load", seals.get)
    assert fresh() is None
    seals["blind_sets"] = {"sets": [{"seal": "b"}]}
    assert fresh() is seals["blind_check"]


def test_every_table_has_what_writes_it_and_a_target():
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    marked = {(str(page.relative_to(ROOT)), name) for page in pages
              for name in re.findall(r"^<!-- (\w+) -->$", page.read_text(encoding="utf-8"),
                                     re.MULTILINE)}  # fmt: skip
    assert marked - {("docs/reproduction.md", "results")} == {(page, name) for page, name, *_ in TABLES
                                                              if name}  # fmt: skip
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in {target for *_, target in TABLES}:
        assert re.search(rf"^{target}: ", makefile, re.MULTILINE), target
    for module in re.findall(r"python -m ((?:experiments|paper_figs)[\w.]*)", makefile):
        path = ROOT / Path(*module.split("."))
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), module
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    shown = [*(ROOT / "docs/figures").iterdir(), *(ROOT / "docs/tables").iterdir()]
    assert [path.name for path in shown if f"{path.parent.name}/{path.name}" not in text] == []


def test_coverages_have_clusters_as_their_units():
    names = (("block", "weight"), ("block", "width"))

    def one(z, ranks, release):
        inside, errors = np.array([[1.0, 0.0, 1.0, release]]), np.array([0.01, -0.03])
        return Estimates(np.zeros((1, 4)), inside, names, errors, np.array(z), np.array(ranks), 1.0, 1000.0)

    cases = [[one([0.5, 3.0], [0.5, 0.999], np.nan)], [one([0.1, -0.2], [0.4, 0.1], 0.0)]]
    found = summarise_estimates(cases)
    assert found["boundaries"]["all"]["coverage_90"] == pytest.approx(4 / 7)  # one is unknown
    assert found["boundaries"]["lift"]["coverage_90"] == 0.0
    weight, every = found["properties"]["weight"], found["properties"]["all"]
    assert weight["rms"] == pytest.approx(0.01) and weight["coverage_68"] == 1.0
    assert every["coverage_95"] == 0.75 and every["laplace_95"] == 0.75
    # Cases cover 1/2 and 2/2: their mean has a standard error of half the difference.
    assert every["coverage_95_se"] == pytest.approx(0.25)


def hand(**deviations):
    zero = {"force_bias": 4, "force_gain": 4, "joint_offset": 4, "link_length": 4, "pad_stiffness": 2}
    return Deviations(**{k: np.zeros(n) + deviations.get(k, 0.0) for k, n in zero.items()})


@pytest.fixture(scope="module")
def trial():
    return simulated_cases(1, trials=1, seed=20_990)[0].trials[0]


def test_deviated_hands_are_read_by_rigs_that_know_their_links_gains_biases_and_pads(trial):
    rig, _ = scene()
    changed = deviated(trial, rig, hand(link_length=0.01, joint_offset=0.002))
    true = {i: f.model_copy(update={"links": tuple(1.01 * x for x in f.links)})
            for i, f in rig.fingers.items()}  # fmt: skip
    channels = {k: v - 0.002 if k.startswith("q") else v for k, v in changed.channels.items()}
    knowing = task_space(type(trial)(trial.file, trial.t, channels), rig.model_copy(update={"fingers": true}))
    expected = task_space(trial, rig)
    for name in ("x1", "y1", "x2", "y2", "vx1", "vy2"):
        np.testing.assert_allclose(getattr(knowing, name), getattr(expected, name), atol=1e-9)
    changed = deviated(trial, rig, hand(force_gain=0.1, force_bias=0.05, pad_stiffness=1.0))
    np.testing.assert_allclose(changed.channels["fx1"], 1.1 * trial.channels["fx1"] + 0.05)
    before, after = task_space(trial, rig), task_space(changed, rig)
    # Twice the stiffness halves the give: tips under grip N lie N / (2 k) further back.
    give = trial.channels["fx1"] / (2 * rig.fingertip.normal_stiffness)
    np.testing.assert_allclose(before.x1 - after.x1, give, atol=1e-9)


def test_every_constant_has_a_kind_and_a_reason_and_a_bare_one_is_seen(tmp_path, monkeypatch):
    assert [f"{c.file}: {c.name}" for c in table.every() if c.kind == "unstated" or not c.reason] == []
    monkeypatch.setattr(table, "ROOT", tmp_path)
    (tmp_path / "module.py").write_text("# physics: m/s^2\nGRAVITY = 9.81\nBARE = 3.0\n")
    found = [(c.name, c.value, c.kind, c.reason) for c in table.constants(tmp_path / "module.py")]
    assert found == [("GRAVITY", "9.81", "physics", "m/s^2"), ("BARE", "3.0", "unstated", "")]


def test_results_say_which_code_made_them_and_nan_is_refused(tmp_path):
    save(tmp_path / "new" / "found.json", {"value": 1.5})
    found = json.loads((tmp_path / "new" / "found.json").read_text())
    assert found == {"value": 1.5, "made_by": commit_of()}
    assert found["made_by"] is None or len(found["made_by"].rstrip("+")) >= 12
    with pytest.raises(ValueError, match="not JSON compliant"):
        save(tmp_path / "found.json", {"value": float("nan")})
    assert not (tmp_path / "found.json").exists()
    known = {"blind_seal.json"}  # a list of hashes, each with the commits that drew and diagnosed the set
    for path in sorted((ROOT / "experiments" / "results").rglob("*.json")):
        if path.name not in known:
            found = json.loads(path.read_text(encoding="utf-8"))
            assert {"made_by", "commits"} & found.keys(), path.name


FAST = "none_1"


def same(kind: str, name: str) -> None:
    assert list(differences(read(kind)[name], rounded(KINDS[kind][1](name)))) == []


def test_what_is_pinned_stays_in_every_folder_but_for_a_share_of_its_sd():
    same("identified", FAST)
    for kind in ("identified", "diagnosed"):
        assert sorted(read(kind)) == folders()
    old = read("identified")["none_1"]
    for name, (mean, sd) in old["properties"].items():
        for shift, found in ((0.2, 0), (0.3, 1)):
            new = copy.deepcopy(old)
            new["properties"][name] = [mean + shift * sd, sd]
            assert len(list(differences(old, new))) == found


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in folders() if name != FAST])
def test_boundaries_and_properties_of_the_other_folders(name: str):
    same("identified", name)


@pytest.mark.slow
@pytest.mark.parametrize("kind, name", [(k, n) for k in ("diagnosed", "ensembles") for n in read(k)])
def test_verdicts_shares_and_parameters_are_those_pinned(kind: str, name: str):
    same(kind, name)


@pytest.mark.parametrize("path, by", [
    (("identified", "none_1", "boundaries", 0, 3, 0), 2e-3),
    (("diagnosed", "force_bias_1", "shares", "force_bias"), 0.06),
    (("diagnosed", "force_bias_1", "shrinkage"), -0.06)])  # fmt: skip
def test_what_moves_by_more_than_it_may_is_seen(path: tuple, by: float):
    old = read(path[0])[path[1]]
    new = copy.deepcopy(old)
    place = new
    for key in path[2:-1]:
        place = place[key]
    place[path[-1]] += by
    assert len(list(differences(old, new))) == 1
    place[path[-1]] -= 0.9 * by
    assert list(differences(old, new)) == [] and len(list(differences(old, new, exact=True))) == 1


STEPS = subtasks(BlockTask({"block": "ground"}, (Move("block", "ground"),)))
TRUTH = (1.0, 2.0, 3.0, 4.0)


def make(starts, number=5) -> Segmentation:
    edges = [0.0, *starts, 5.0]
    spans = [Span(s.name, s.object, s.state, a, b, 0.1, 0.1, (a - 0.1, a + 0.1), (b - 0.1, b + 0.1))
             for s, a, b in zip(STEPS, edges, edges[1:], strict=False)]  # fmt: skip
    return Segmentation("made.csv", 20.0, None, tuple(spans[:number]))


def test_boundaries_against_truth_and_their_summary_leaves_out_what_is_missing():
    segmentation = make([1.05, 1.8, 3.0, 4.2])
    np.testing.assert_allclose(scoring.boundary_residuals(segmentation, TRUTH), [0.05, -0.2, 0.0, 0.2],
                               atol=1e-12)  # fmt: skip
    np.testing.assert_array_equal(scoring.boundaries_covered(segmentation, TRUTH), [1, 0, 1, 0])
    missing = make([1.0, 2.0], 3)
    assert np.isnan(scoring.boundary_residuals(missing, TRUTH)).all()
    assert np.isnan(scoring.boundaries_covered(missing, TRUTH)).all()
    summary = scoring.summarise_boundaries(np.array([-0.1, 0.3, math.nan]), np.array([1.0, 0.0, math.nan]))
    assert summary == pytest.approx({"median": 0.2, "percentile_95": 0.29, "coverage_90": 0.5})
    assert scoring.summarise_boundaries(np.array([math.nan]), np.array([math.nan]))["median"] is None


def test_states_and_properties_against_truth():
    t = np.arange(0, 5, 0.1)
    assert scoring.state_accuracy(make(TRUTH), TRUTH, t, STEPS) == 1.0
    assert scoring.state_accuracy(make([1.0, 2.0, 3.0, 4.5]), TRUTH, t, STEPS) == pytest.approx(0.9)
    assert scoring.state_accuracy(Segmentation("made.csv", 20.0, None, ()), TRUTH, t, STEPS) == 0.0
    estimate = {"mean": 1.1, "interval_68": [1.05, 1.15], "interval_95": [0.95, 1.25]}
    blocks = {"block": {"weight": (1.0, 0.0), "width": (2.0, 0.0), "friction": (1.2, 0.0)}}
    scores = scoring.property_scores({"block": {"weight": estimate, "width": None}}, blocks)
    assert [s["property"] for s in scores] == ["weight", "width"]
    assert scores[0]["residual"] == pytest.approx(0.1)
    assert (scores[0]["in_68"], scores[0]["in_95"]) == (False, True)
    summary = scoring.summarise_properties(scores)
    assert summary["weight"] == pytest.approx({"count": 1, "null": 0, "rms": 0.1, "coverage_68": 0.0,
                                               "coverage_95": 1.0})  # fmt: skip
    assert summary["width"] == {"count": 0, "null": 1} and summary["height"] == {"count": 0, "null": 0}


def test_the_rules_on_the_paper_s_blocks_and_a_folder_without_cases(tmp_path):
    folder = Path(__file__).resolve().parents[2] / "recordings/paper_blocks"
    assert list_cases(folder) == [folder]
    case = read_case(folder)
    assert case.healthy and case.blocks["block1"]["weight"] == (0.343, 0.0005)
    scores = {name: score_case(case, METHODS[name], 4, 0) for name in ("qualitative", "first-change")}
    assert len(scores["qualitative"]["properties"]) == 2 * 2 * 3  # two groups, two blocks
    json.dumps(scores["qualitative"], allow_nan=False)
    ordered, plain = (summarise([scores[name]])["boundaries"] for name in scores)
    assert ordered["median"] < 0.025 and ordered["percentile_95"] < plain["percentile_95"]
    refused("holds no case", list_cases, tmp_path)


def entry(case: str, tier: str, effects: dict, size: float = 0.5, measured: bool = True) -> dict:
    """A label made by hand: grip and fy shifted while block1 is carried."""
    row = {c: [0.0] * 9 for c in ("x", "y", "distance", "offset", "vx", "vy", "fx", "fy", "grip", "shear")}
    if effects:
        row = row | {"fy": [0.0, 0.0, 5.0, *[0.0] * 6], "grip": [0.0, 0.0, 4.0, *[0.0] * 6]}
    return {"case": case, "tier": tier, "effects": effects, "sizes": dict.fromkeys(effects, size),
            "measured": measured, "shift": [row, row], "spread": [row, row],
            "subtasks": TASKS["reversal"].subtasks,
            "world": {"rate": 20.0}, "brackets": {"rate": "20 Hz"}}  # fmt: skip


def said(verdict: str, causes: list[str], partners: list[str] = (), **more) -> dict:  # type: ignore[assignment]
    name = "+".join(causes) or verdict
    effects = {c: {"parameters": more.pop("parameters", {})} for c in causes[:1]}
    body = {"verdict": verdict, "causes": causes, "indistinguishable": list(partners),
            "probabilities": {name: 0.95, "other": 0.05}, "effects": effects,
            "attribution": {c: {"probability": 0.95, "share": 0.9} for c in causes},
            "remainder": {"share": 0.1, "p_value": 0.5, "where": []},
            "where": [{"channel": "fy", "subtask": "carry block1"},
                      {"channel": "x", "subtask": "place block1"}], "shrinkage": None, "bic": "force_bias",
            "gains": {}, "seconds": 10.0}  # fmt: skip
    return body | more


def test_the_scorer_counts_hand_made_results():
    interval = {"fy1": {"interval_90": [0.05, 0.15]}, "fx1": {"interval_90": [0.3, 0.4]}}
    bias = {"force_bias": {"fy1": 0.1, "fx1": 0.1}}
    lag, both = {"force_lag": {"delay": 0.1}}, {"force_bias": {}, "force_lag": {}}
    hum, dense = {"mains_hum": {"amplitude": 0.1}}, {"force_bias": {}, "force_lag": {}, "table_tilt": {}}
    rest = {"remainder": {"share": 0.5, "p_value": 0.0, "where": []}}
    wide = entry("m", "dense", dense, 0.05) | {"sizes": {"force_bias": 0.8, "force_lag": 0.1,
                                                         "table_tilt": 0.05}}  # fmt: skip
    rows = [
        judge_case(entry("a", "healthy", {}), said("none", [], where=[])),
        judge_case(entry("b", "healthy", {}), said("named", ["force_lag"], where=[])),
        judge_case(entry("c", "single", bias), said("named", ["force_bias"], parameters=interval)),
        judge_case(entry("d", "single", bias), said("set", ["fingertip_mass"], ["force_bias"])),
        judge_case(entry("e", "single", bias, 0.1), said("none", [], gains={"force_bias": 2.0})),
        judge_case(entry("f", "single", lag), said("unknown", [], gains={"force_lag": 30.0})),
        judge_case(entry("g", "outside", hum), said("unknown", [])),
        judge_case(entry("h", "outside", hum), said("named", ["force_lag"], **rest)),
        judge_case(entry("i", "outside", hum), said("named", ["force_lag"])),
        judge_case(entry("j", "withheld", {"fingertip_mass": {"mass": 0.01}}), said("named", ["force_bias"])),
        judge_case(entry("k", "withheld", {"force_gain": {"gain": 0.1}}),  # measured: no partner
                   said("named", ["fingertip_compliance"])),
        judge_case(entry("l", "pair", both), said("named", ["force_bias", "force_lag"])),
        judge_case(wide, said("named", ["force_bias"])),
        judge_case(entry("n", "slight", bias), said("none", []))]  # fmt: skip
    found = figures(rows)
    table = found["table"]
    assert table["false_alarms"]["value"] == 0.5 and table["slight_none"]["value"] == 1.0
    assert table["named_right"]["count"] == 3  # e cannot be seen
    assert table["named_right"]["hits"] == 1 and table["set_right"]["hits"] == 2
    assert table["known_rejected"]["hits"] == 1
    assert (table["outside_right"]["hits"], table["outside_right"]["count"]) == (2, 3)
    assert table["withheld_right"]["value"] == 0.5
    assert table["pair_both"]["value"] == 1.0 and table["dense_dominant"]["value"] == 1.0
    assert table["coverage_90"]["value"] == 0.5 and table["small_none"]["value"] == 1.0
    assert table["inclusion_dense"]["value"] == pytest.approx(0.05)
    # Of each but the healthy ones: one hit, one false, one missed cell.
    assert table["location_f1"]["value"] == pytest.approx(0.5) and table["bic_named"]["hits"] == 2
    assert found["brackets"]["rate"]["20 Hz"]["false_alarms"]["value"] == 0.5
    low, high = table["false_alarms"]["interval_95"]
    assert low == pytest.approx(0.0126, abs=1e-3) and high == pytest.approx(0.9874, abs=1e-3)


def test_refused_recordings_count_as_wrong_and_calibration_is_right_where_odds_come_true():
    refused = {"error": "does not fit its task", "seconds": 1.0}
    one, two = {"force_bias": {"fy1": 0.1}}, {"force_bias": {}, "force_lag": {}}
    tiers = (("healthy", {}), ("single", one), ("pair", two), ("outside", {"mains_hum": {}}),
             ("withheld", one))  # fmt: skip
    table = figures([judge_case(entry(tier, tier, effects), refused) for tier, effects in tiers])["table"]
    assert table["false_alarms"]["value"] == 1.0 and table["errors"]["value"] == 1.0
    for name in ("named_right", "set_right", "outside_right", "withheld_right", "pair_both"):
        assert table[name]["count"] == 1 and table[name]["hits"] == 0
    rng = np.random.default_rng(1)
    p = rng.random((200, 20))
    honest = calibration([[(v, rng.random() < v) for v in row] for row in p])
    vain = calibration([[(0.95, rng.random() < 0.6) for _ in row] for row in p])
    assert honest["value"] < 0.03 and vain["value"] == pytest.approx(0.35, abs=0.03)
    assert vain["interval_95"][0] < 0.35 < vain["interval_95"][1] + 0.02


def test_noise_is_coloured_as_drawn_and_the_estimator_is_told_what_the_row_says():
    rng, t = np.random.default_rng(0), np.arange(40_000) / 20.0
    clean = Trial("x.csv", t, {"fx1": np.sin(t)})
    noisy = Trial("x.csv", t, {"fx1": np.sin(t) + 0.1 * rng.normal(size=t.size)})
    noise = _coloured(noisy, clean, 0.5).channels["fx1"] - np.sin(t)
    assert noise.std() == pytest.approx(0.1, rel=0.03)
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(0.5, abs=0.03)
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


@pytest.mark.parametrize(("tier", "found", "expected"), [
    ("healthy", {"verdict": "none"}, "quiet"),
    ("healthy", {"verdict": "unknown"}, "false alarm"),
    ("healthy", {"error": "ValueError: no"}, "error"),
    ("single", {"verdict": "named", "causes": ["force_lag"]}, "named"),
    ("single", {"verdict": "set", "causes": ["force_lowpass"], "indistinguishable": ["force_lag"]},
     "set"),
    ("single", {"verdict": "named", "causes": ["clock_jitter", "force_lag"]}, "beside others"),
    ("single", {"verdict": "named", "causes": ["force_lowpass"], "indistinguishable": []}, "wrong name"),
    ("single", {"verdict": "none", "small_gap": {"size": 1.0}}, "too small"),
    ("single", {"verdict": "none"}, "missed"),
    ("pair", {"verdict": "named", "causes": ["grip_slip", "force_lag"]}, "named"),
    ("pair", {"verdict": "named", "causes": ["force_lag"]}, "half"),
    ("outside", {"verdict": "unknown", "causes": []}, "unknown"),
    ("outside", {"verdict": "named", "causes": ["table_tilt"]}, "wrong name")])  # fmt: skip
def test_outcomes(tier, found, expected):
    effects = ["force_lag", "grip_slip"] if tier == "pair" else ["force_lag"]
    assert outcome({"tier": tier, "effects": effects}, found) == expected
