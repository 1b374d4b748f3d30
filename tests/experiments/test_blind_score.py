"""The blind check's score, on results made by hand."""

import numpy as np
import pytest

from experiments.blind_check.judge import judge_case
from experiments.blind_check.scene import TASKS
from experiments.blind_check.score import calibration, figures


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
    """A diagnosis made by hand."""
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
        judge_case(entry("n", "slight", bias), said("none", [])),
    ]  # fmt: skip
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


def test_a_recording_that_is_refused_counts_and_is_wrong():
    refused = {"error": "does not fit its task", "seconds": 1.0}
    one, two = {"force_bias": {"fy1": 0.1}}, {"force_bias": {}, "force_lag": {}}
    tiers = (("healthy", {}), ("single", one), ("pair", two), ("outside", {"mains_hum": {}}),
             ("withheld", one))  # fmt: skip
    table = figures([judge_case(entry(tier, tier, effects), refused) for tier, effects in tiers])["table"]
    assert table["false_alarms"]["value"] == 1.0 and table["errors"]["value"] == 1.0
    for name in ("named_right", "set_right", "outside_right", "withheld_right", "pair_both"):
        assert table[name]["count"] == 1 and table[name]["hits"] == 0


def test_calibration_is_right_where_probabilities_come_true():
    rng = np.random.default_rng(1)
    p = rng.random((200, 20))
    honest = calibration([[(v, rng.random() < v) for v in row] for row in p])
    vain = calibration([[(0.95, rng.random() < 0.6) for _ in row] for row in p])
    assert honest["value"] < 0.03 and vain["value"] == pytest.approx(0.35, abs=0.03)
    assert vain["interval_95"][0] < 0.35 < vain["interval_95"][1] + 0.02
