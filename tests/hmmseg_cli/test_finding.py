"""Numbers and findings in words: from a diagnosis's JSON alone, old and new."""

import re

import pytest

from hmmseg.numbers import between, estimate, fixed, interval, percent, plain, shown_as
from hmmseg_cli.pages import Setting, page
from simgap.effects import catalogue
from simgap.report.finding import (
    chances,
    changed,
    checks,
    headline,
    moving,
    plain_name,
    remains,
    sentences,
    settles,
    to_do,
)
from simgap.robot_effects import FAMILIES
from simgap.simulators.mjcf.setting import KINDS


def cell(channel: str, subtask: str, share: float, trial: str = "trial_01.csv", band=(0.0, 1.0)) -> dict:
    where = {"trial": trial, "channel": channel, "subtask": subtask, "band": list(band)}
    return where | {"share": share, "z": 100 * share}


def body(verdict: str, causes: list[str], **more) -> dict:
    name = "+".join(causes) or verdict
    parameters = {"normal_stiffness": {"mean": 3985.0, "sd": 181.0, "interval_90": [3687.0, 4283.0],
                                       "unit": "N/m"}}  # fmt: skip
    shift = {"block1.width": {"before": 0.0134, "after": 0.0162, "unit": "m"}}
    effects = {name: {"parameters": parameters, "log_evidence": 12.0, "heldout_score": 9.0,
                      "property_shift": shift}}  # fmt: skip
    return {
        "verdict": verdict, "causes": causes, "indistinguishable": [], "probabilities": {name: 0.93},
        "detection": {"p_value": 1e-20, "statistic": 5.0}, "effects": effects if causes else {},
        "where": [cell("offset", "carry block1", 0.4), cell("offset", "carry block1", 0.21, "trial_02.csv"),
                  cell("fy", "place block1", 0.004, band=(1.0, 5.0))],
        "shrinkage": None, "next_experiment": None,
    } | more  # fmt: skip


def test_numbers_have_one_unit_and_no_exponent():
    assert estimate(3985.4, 181.2, shown_as("N/m")) == "3985 ± 180 N/m"
    assert estimate(0.01234, 0.00056, shown_as("m")) == "12.34 ± 0.56 mm"
    assert estimate(0.05, 0.004, shown_as("1", share=True)) == "5.00 ± 0.40 %"
    assert estimate(-1.2e-5, 3e-6, shown_as("rad")) == "-0.0120 ± 0.0030 mrad"
    assert interval(3687.2, 4283.0, shown_as("N/m")) == "3687 to 4283 N/m"
    assert plain(180.0) == "180" and plain(0.000123) == "0.000123" and plain(float("inf")) == "infinite"
    assert percent(0.004) == "under 1 %" and percent(0.997) == "over 99 %" and percent(1.0) == "100 %"
    assert between(0.62, 0.78) == "62 to 78 %" and between(0.9961, 1.0) == "" and between(None, 1.0) == ""


def test_every_effect_has_a_plain_name_and_a_check():
    for name, effect in catalogue().items():
        assert effect.called and checks([name]) == [effect.check] and effect.check.endswith(".")
    for family in FAMILIES:
        for kind, (called, check) in family.WORDS.items():
            whole = kind.replace(".", ":arm x.") if kind.split(".")[0] in ("readout", "pose") else kind
            assert plain_name(whole) == called + (" (arm x)" if whole != kind else "")
            assert checks([whole]) == [check] and check.endswith(".")
    assert plain_name("readout:z.gain") == "a reading that is off by a factor (z)"
    assert (plain_name("gravity_compensation") == "gravity compensation"
            and checks(["gravity_compensation"]) == [])  # fmt: skip
    assert plain_name("fingertip_compliance", {"normal_stiffness": 1200.0},
                      {"normal_stiffness": 4000.0}) == ("softer fingertips")  # fmt: skip
    assert plain_name("force_gain", {"finger1": 0.0, "finger2": -0.1}).endswith("too low (finger 2)")
    assert plain_name("force_lag", {"finger1": 0.1, "finger2": 0.0}).endswith("late of finger 1")
    assert plain_name("force_bias", {"fx1": 1.2, "fy1": 0.01}).endswith("force sensor fx1")
    assert plain_name("something_new") == "something new"


def test_a_named_cause_is_told_with_what_it_leaves():
    found = body("named", ["fingertip_compliance"],
                 attribution={"fingertip_compliance": {"probability": 0.94, "share": 0.87,
                                                       "interval_90": [0.8, 0.91]}},
                 remainder={"share": 0.13, "p_value": 1e-6,
                            "where": [cell("offset", "carry block1", 0.1)]})  # fmt: skip
    assert headline(found, {"normal_stiffness": 4000.0}) == "Softer fingertips"
    told = " ".join(sentences(found))
    assert "93 %" in told and "It explains 87 % of the gap (90 % interval 80 to 91 %)" in told
    left = remains(found)
    assert left[0].startswith("13 % of the gap remains")
    assert left[1].startswith(
        "The height difference of the fingers is off while you carry block1: 10 % of what remains"
    )


def test_a_cause_of_the_smaller_part_is_said_to_be_that():
    found = body("named", ["table_tilt"], remainder={"share": 0.9, "p_value": 0.0, "where": []})
    assert headline(found) == "A table that is not level, and a larger gap that no known cause explains"


def test_no_more_is_said_of_noise_and_one_probability_of_a_cause():
    left = {"share": 0.62, "p_value": 1.0, "where": [cell("vy", "carry block1", 0.3)]}
    own = {"force_gain": {"probability": 0.8, "share": 0.38, "interval_90": [0.3, 0.4]}}
    found = body("named", ["force_gain"], remainder=left, attribution=own)
    assert "larger gap" not in headline(found)
    assert remains(found) == ["What remains, 62 % of the gap, is within the noise (p = 1.0)."]
    assert chances(found) == {"force_gain": 0.93}
    assert "--actual" in settles(found, weighed=False) and settles(found, weighed=True) == ""


def test_each_of_two_causes_is_told_by_its_own_parameters():
    means = {"force_bias.fx1": 0.0, "force_bias.fy1": 0.08, "table_compliance.stiffness": 32000.0}
    said = plain_name("force_bias+table_compliance", means)
    assert said == "a zero error of force sensor fy1 and a table that yields under load"
    own = {n: {"probability": 0.8, "share": s} for n, s in (("force_bias", 0.7), ("table_tilt", 0.3))}
    found = body("named", ["force_bias", "table_tilt"], attribution=own)
    told = " ".join(sentences(found))
    assert "70 % is explained by zero errors of the force sensors, 30 % by a table" in told


def test_a_part_of_a_robot_is_told_in_words_with_the_models_own_value():
    parameters = {"frictionloss": {"mean": 0.12, "sd": 0.01, "interval_90": [0.1, 0.14], "unit": "N m",
                                   "nominal": 0.0}}  # fmt: skip
    cause = "joint:elbow.frictionloss"
    found = body("named", [cause]) | {"effects": {cause: {"parameters": parameters, "log_evidence": 3.0}}}
    assert headline(found) == "Elbow: dry friction 0.120 N m (model: 0)"
    assert to_do(found) == ["Turn elbow by hand, unpowered."]
    text = page(found, Setting(["a.csv"]), lambda path: None)
    assert ">elbow: dry friction<" in text and ">0 N m<" in text and ">0.120 ± 0.010 N m<" in text


def test_every_part_of_a_model_that_is_offered_has_words_and_a_check():
    kinds = [  # parts of one effect, joint.stribeck, joint.cogging
        f"{kind}.{re.sub('_(extra|speed|per_turn|cos|sin)$', '', what)}"
        for kind, (_, known) in KINDS.items() for what in known if kind in ("joint", "actuator")
    ]  # fmt: skip
    for kind in (*kinds, "body.mass", "body.com", "body.payload", "geom.friction"):
        head, _, what = kind.partition(".")
        name = f"{head}:elbow.{what}"
        assert plain_name(name).startswith("elbow: ") and "elbow" in checks([name])[0]
        assert "Measure it of" not in checks([name])[0]


def test_what_rounds_to_nothing_has_no_sign():
    assert fixed(-0.001, 2, "+") == "+0.00" and fixed(-0.001, 2) == "0.00" and fixed(-0.006, 2) == "-0.01"
    assert percent(-0.001) == "0 %"


def test_an_unknown_gap_says_what_moves():
    found = body("unknown", [], remainder={"share": 0.7, "p_value": 1e-9, "where": []})
    first, second = moving(found)
    assert first == ("The height difference of the fingers is off while you carry block1: 61 % of the gap, "
                     "in 2 trials.")  # fmt: skip
    assert second.startswith(
        "The net vertical force moves differently while you press block1 down: under 1 %"
    )
    assert "what acts there" in to_do(found)[-1]
    assert remains(found) == ["70 % of the gap is left after every likely cause."]


def test_a_small_gap_is_no_gap_that_matters():
    small = {"size": 0.0003, "unit": "m", "where": [cell("y", "place block1", 0.9)]}
    found = body("none", [], small_gap=small, where=[])
    assert headline(found) == "No gap that matters"
    assert "less than matters: 0.300 mm at most" in sentences(found)[0]


@pytest.mark.parametrize("verdict", ["none", "named", "set", "unknown"])
def test_every_verdict_has_a_page(verdict):
    causes = ["fingertip_compliance"] if verdict in ("named", "set") else []
    more = {"indistinguishable": ["force_gain"]} if verdict == "set" else {}
    if verdict == "none":
        more = {"where": []}
    measured = {"block1": {"width": (0.016, 0.0001)}} if causes else None
    text = page(body(verdict, causes, **more), Setting(["a.csv"], {}, measured), lambda path: None)
    assert 'id="verdict"' in text and "<script" not in text and ('id="parameters"' in text) == bool(causes)
    if verdict != "none":
        assert text.count(">61 %<") == 1
    if causes:
        assert "3985 ± 180 N/m" in text and "1.6200 cm" in text


ROBOT = {"verdict": "unknown", "causes": [], "indistinguishable": [], "effects": {}, "numerics": {},
         "detection": {"p_value": 0.0, "resolution": 0.0}, "next_experiment": None, "shrinkage": None,
         "probabilities": {"none": 0.0, "unknown": 1.0}, "remainder": {"share": 1.0, "rms_over_noise": 11.5},
         "explanation": {"effects": ["joint:slew.armature"], "doubts": ["11.5 times the noise is left"]},
         "attribution": {"joint:slew.armature": {"probability": 0.68, "share": 0.0,
                                                 "interval_90": [0.0, 0.0]}},
         "where": [{"trial": "a.csv", "channel": "q1", "subtask": "moving", "band": [0.0, 50.0], "share": 1.0,
                    "z": 9.0}]}  # fmt: skip


def test_an_unknown_gap_of_a_robot_names_the_best_and_why_it_is_none():
    said = " ".join([*sentences(ROBOT), *remains(ROBOT)])
    assert "slew: rotor inertia, is doubtful: 11.5 times the noise is left" in said
    assert "while it moves: 100 % of the gap" in said
    shown = page(ROBOT, Setting(["a.csv"]), lambda path: None)
    assert "None explains a hundredth of the gap" in shown and "68 %" not in shown
    assert "Logs of a robot that is as its model differ" in shown


def test_a_change_that_nothing_explains_is_told_with_its_size_and_chance():
    left = {"share": None, "p_value": 0.0074, "where": [], "rms_over_noise": 1.0119}
    (said,) = changed(body("unknown", [], changes=[], remainder=left))
    assert said.endswith("new logs is 1.01 times that on the old ones (p = 0.0074 if nothing changed).")


def test_causes_that_act_together_are_listed_once_in_units_that_read_well():
    found = {"body:arm.payload": (0.0894, 0.0, "kg"), "joint:slew.frictionloss": (0.451, 0.05, "N m")}
    parameters = {
        f"{n}.{n.rpartition('.')[2]}": {
            "mean": m, "sd": 0.001, "interval_90": [m, m], "unit": unit, "nominal": nominal
        }
        for n, (m, nominal, unit) in found.items()
    }  # fmt: skip
    pair, act = "+".join(found), {"probability": 0.5, "share": 0.5, "interval_90": None}
    body = ROBOT | {"verdict": "named", "causes": list(found), "effects": {pair: {"parameters": parameters}},
                    "probabilities": {pair: 0.99}, "attribution": dict.fromkeys(found, act),
                    "explanation": None}  # fmt: skip
    assert headline(body) == "Arm: a load 89.4 g (model: 0) and slew: dry friction 0.451 N m (model: 0.0500)"
    assert chances(body) == dict.fromkeys(found, 0.99)


def test_what_remains_is_called_noise_by_its_p_value_alone():
    left = {"remainder": {"share": 0.003, "p_value": 1e-15, "where": []}}
    assert remains(body("named", ["table_compliance"], **left)) == [
        "Under 1 % of the gap remains (p = 1e-15), which is more than noise."
    ]
    left["remainder"]["p_value"] = 0.6
    assert "is within the noise (p = 0.60)" in remains(body("named", ["cable_force"], **left))[0]
