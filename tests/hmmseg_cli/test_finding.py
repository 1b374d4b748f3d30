"""Numbers and findings in words, from documents alone, and figures, of awkward results too."""

import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.text import Text

from estimation.plots import Prediction, draw_corner, draw_estimates, draw_predictive
from hmmseg.contact.decompose import subtasks
from hmmseg.hand.signals import Signals
from hmmseg.io.task import BlockTask, Move
from hmmseg.io.trial import Trial
from hmmseg.numbers import between, estimate, fixed, interval, percent, plain, shown_as
from hmmseg.plot import style as drawing
from hmmseg.plot.spans import MOST, draw_channels, draw_signals
from hmmseg.segmentation.spans import Failure, Segmentation, Span
from hmmseg_cli.pages import Setting, page
from simgap.effects import catalogue
from simgap.report import finding
from simgap.robot_effects import FAMILIES
from simgap.simulators.mjcf.setting import KINDS

ROBOT = {"verdict": "unknown", "causes": [], "indistinguishable": [], "effects": {}, "numerics": {},
         "detection": {"p_value": 0.0, "resolution": 0.0}, "next_experiment": None, "shrinkage": None,
         "probabilities": {"none": 0.0, "unknown": 1.0}, "remainder": {"share": 1.0, "rms_over_noise": 11.5},
         "explanation": {"effects": ["joint:slew.armature"], "doubts": ["11.5 times the noise is left"]},
         "attribution": {"joint:slew.armature": {"probability": 0.68, "share": 0.0,
                                                 "interval_90": [0.0, 0.0]}},
         "where": [{"trial": "a.csv", "channel": "q1", "subtask": "moving", "band": [0.0, 50.0], "share": 1.0,
                    "z": 9.0}]}  # fmt: skip


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


def test_numbers_have_one_unit_no_exponent_and_no_sign_of_nothing():
    assert estimate(3985.4, 181.2, shown_as("N/m")) == "3985 ± 180 N/m"
    assert estimate(0.01234, 0.00056, shown_as("m")) == "12.34 ± 0.56 mm"
    assert estimate(0.05, 0.004, shown_as("1", share=True)) == "5.00 ± 0.40 %"
    assert estimate(-1.2e-5, 3e-6, shown_as("rad")) == "-0.0120 ± 0.0030 mrad"
    assert interval(3687.2, 4283.0, shown_as("N/m")) == "3687 to 4283 N/m"
    assert plain(180.0) == "180" and plain(0.000123) == "0.000123" and plain(float("inf")) == "infinite"
    assert percent(0.004) == "under 1 %" and percent(0.997) == "over 99 %" and percent(1.0) == "100 %"
    assert between(0.62, 0.78) == "62 to 78 %" and between(0.9961, 1.0) == "" and between(None, 1.0) == ""
    assert fixed(-0.001, 2, "+") == "+0.00" and fixed(-0.001, 2) == "0.00" and fixed(-0.006, 2) == "-0.01"
    assert percent(-0.001) == "0 %"


def test_effects_and_parts_of_models_have_plain_names_and_checks():
    for name, effect in catalogue().items():
        assert effect.called and finding.checks([name]) == [effect.check] and effect.check.endswith(".")
    for family in FAMILIES:
        for kind, (called, check) in family.WORDS.items():
            whole = kind.replace(".", ":arm x.") if kind.split(".")[0] in ("readout", "pose") else kind
            assert finding.plain_name(whole) == called + (" (arm x)" if whole != kind else "")
            assert finding.checks([whole]) == [check] and check.endswith(".")
    assert finding.plain_name("readout:z.gain") == "a reading that is off by a factor (z)"
    assert (finding.plain_name("gravity_compensation") == "gravity compensation"
            and finding.checks(["gravity_compensation"]) == [])  # fmt: skip
    assert finding.plain_name("fingertip_compliance", {"normal_stiffness": 1200.0},
                      {"normal_stiffness": 4000.0}) == ("softer fingertips")  # fmt: skip
    assert finding.plain_name("force_gain", {"finger1": 0.0, "finger2": -0.1}).endswith("too low (finger 2)")
    assert finding.plain_name("force_lag", {"finger1": 0.1, "finger2": 0.0}).endswith("late of finger 1")
    assert finding.plain_name("force_bias", {"fx1": 1.2, "fy1": 0.01}).endswith("force sensor fx1")
    assert finding.plain_name("something_new") == "something new"
    kinds = [  # parts of one effect, joint.stribeck, joint.cogging
        f"{kind}.{re.sub('_(extra|speed|per_turn|cos|sin)$', '', what)}"
        for kind, (_, known) in KINDS.items() for what in known if kind in ("joint", "actuator")]  # fmt: skip
    for kind in (*kinds, "body.mass", "body.com", "body.payload", "geom.friction"):
        head, _, what = kind.partition(".")
        name = f"{head}:elbow.{what}"
        assert finding.plain_name(name).startswith("elbow: ") and "elbow" in finding.checks([name])[0]
        assert "Measure it of" not in finding.checks([name])[0]


def test_a_cause_is_told_with_what_it_leaves_and_of_the_smaller_part_as_that():
    found = body("named", ["fingertip_compliance"],
                 attribution={"fingertip_compliance": {"probability": 0.94, "share": 0.87,
                                                       "interval_90": [0.8, 0.91]}},
                 remainder={"share": 0.13, "p_value": 1e-6,
                            "where": [cell("offset", "carry block1", 0.1)]})  # fmt: skip
    assert finding.headline(found, {"normal_stiffness": 4000.0}) == "Softer fingertips"
    told = " ".join(finding.sentences(found))
    assert "93 %" in told and "It explains 87 % of the gap (90 % interval 80 to 91 %)" in told
    left = finding.remains(found)
    assert left[0].startswith("13 % of the gap remains")
    assert left[1].startswith(
        "The height difference of the fingers is off while you carry block1: 10 % of what remains"
    )
    found = body("named", ["table_tilt"], remainder={"share": 0.9, "p_value": 0.0, "where": []})
    assert (
        finding.headline(found) == "A table that is not level, and a larger gap that no known cause explains"
    )


def test_what_remains_is_called_noise_by_its_p_value_alone_and_no_more_is_said_of_it():
    left = {"share": 0.62, "p_value": 1.0, "where": [cell("vy", "carry block1", 0.3)]}
    own = {"force_gain": {"probability": 0.8, "share": 0.38, "interval_90": [0.3, 0.4]}}
    found = body("named", ["force_gain"], remainder=left, attribution=own)
    assert "larger gap" not in finding.headline(found)
    assert finding.remains(found) == ["What remains, 62 % of the gap, is within the noise (p = 1.0)."]
    assert finding.chances(found) == {"force_gain": 0.93}
    assert "--actual" in finding.settles(found, weighed=False) and finding.settles(found, weighed=True) == ""
    left = {"remainder": {"share": 0.003, "p_value": 1e-15, "where": []}}
    assert finding.remains(body("named", ["table_compliance"], **left)) == [
        "Under 1 % of the gap remains (p = 1e-15), which is more than noise."
    ]
    left["remainder"]["p_value"] = 0.6
    assert "is within the noise (p = 0.60)" in finding.remains(body("named", ["cable_force"], **left))[0]


def test_each_of_two_causes_is_told_by_its_own_parameters_and_a_change_with_its_chance():
    means = {"force_bias.fx1": 0.0, "force_bias.fy1": 0.08, "table_compliance.stiffness": 32000.0}
    said = finding.plain_name("force_bias+table_compliance", means)
    assert said == "a zero error of force sensor fy1 and a table that yields under load"
    own = {n: {"probability": 0.8, "share": s} for n, s in (("force_bias", 0.7), ("table_tilt", 0.3))}
    found = body("named", ["force_bias", "table_tilt"], attribution=own)
    told = " ".join(finding.sentences(found))
    assert "70 % is explained by zero errors of the force sensors, 30 % by a table" in told
    left = {"share": None, "p_value": 0.0074, "where": [], "rms_over_noise": 1.0119}
    (said,) = finding.changed(body("unknown", [], changes=[], remainder=left))
    assert said.endswith("new logs is 1.01 times that on the old ones (p = 0.0074 if nothing changed).")


def test_gaps_of_robots_are_told_by_parts_in_words_with_the_models_own_value():
    parameters = {"frictionloss": {"mean": 0.12, "sd": 0.01, "interval_90": [0.1, 0.14], "unit": "N m",
                                   "nominal": 0.0}}  # fmt: skip
    cause = "joint:elbow.frictionloss"
    found = body("named", [cause]) | {"effects": {cause: {"parameters": parameters, "log_evidence": 3.0}}}
    assert finding.headline(found) == "Elbow: dry friction 0.120 N m (model: 0)"
    assert finding.to_do(found) == ["Turn elbow by hand, unpowered."]
    text = page(found, Setting(["a.csv"]), lambda path: None)
    assert ">elbow: dry friction<" in text and ">0 N m<" in text and ">0.120 ± 0.010 N m<" in text
    said = " ".join([*finding.sentences(ROBOT), *finding.remains(ROBOT)])
    assert "slew: rotor inertia, is doubtful: 11.5 times the noise is left" in said
    assert "while it moves: 100 % of the gap" in said
    shown = page(ROBOT, Setting(["a.csv"]), lambda path: None)
    assert "None explains a hundredth of the gap" in shown and "68 %" not in shown
    assert "Logs of a robot that is as its model differ" in shown


def test_an_unknown_gap_says_what_moves_and_a_small_one_is_none():
    found = body("unknown", [], remainder={"share": 0.7, "p_value": 1e-9, "where": []})
    first, second = finding.moving(found)
    assert first == ("The height difference of the fingers is off while you carry block1: 61 % of the gap, "
                     "in 2 trials.")  # fmt: skip
    assert second.startswith(
        "The net vertical force moves differently while you press block1 down: under 1 %"
    )
    assert "what acts there" in finding.to_do(found)[-1]
    assert finding.remains(found) == ["70 % of the gap is left after every likely cause."]
    small = {"size": 0.0003, "unit": "m", "where": [cell("y", "place block1", 0.9)]}
    found = body("none", [], small_gap=small, where=[])
    assert finding.headline(found) == "No gap that matters"
    assert "less than matters: 0.300 mm at most" in finding.sentences(found)[0]


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


def test_causes_that_act_together_are_listed_once_in_units_that_read_well():
    found = {"body:arm.payload": (0.0894, 0.0, "kg"), "joint:slew.frictionloss": (0.451, 0.05, "N m")}
    parameters = {
        f"{n}.{n.rpartition('.')[2]}": {
            "mean": m, "sd": 0.001, "interval_90": [m, m], "unit": unit, "nominal": nominal
        }
        for n, (m, nominal, unit) in found.items()}  # fmt: skip
    pair, act = "+".join(found), {"probability": 0.5, "share": 0.5, "interval_90": None}
    body = ROBOT | {"verdict": "named", "causes": list(found), "effects": {pair: {"parameters": parameters}},
                    "probabilities": {pair: 0.99}, "attribution": dict.fromkeys(found, act),
                    "explanation": None}  # fmt: skip
    assert (
        finding.headline(body)
        == "Arm: a load 89.4 g (model: 0) and slew: dry friction 0.451 N m (model: 0.0500)"
    )
    assert finding.chances(body) == dict.fromkeys(found, 0.99)


T = np.arange(100) * 0.05
NAMES = [("block1", "weight"), ("block1", "width"), ("block1", "height")]
PROPERTIES = {"block1": {"weight": {"unit": "N", "mean": 0.35, "sd": 0.01, "interval_68": [0.34, 0.36],
                                    "interval_95": [0.33, 0.37]}, "width": None,
                         "friction": {"lower_bound": 0.5}}}  # fmt: skip


@pytest.fixture
def texts(monkeypatch):
    """Every text of the figures drawn, gathered as they are saved."""
    found: list[str] = []
    save = drawing.Figure.savefig

    def gather(figure, *args, **kwargs):
        save(figure, *args, **kwargs)
        found.extend(text.get_text() for text in figure.findobj(Text))

    monkeypatch.setattr(drawing.Figure, "savefig", gather)
    return found


def make_segmentation() -> Segmentation:
    steps, sd = subtasks(BlockTask({"block": "ground"}, (Move("block", "ground"),))), 0.01
    spans = tuple(
        Span(s.name, s.object, s.state, 1.0 * i, i + 1.0, sd, sd, (i - 0.02, i + 0.02), (i + 0.98, i + 1.02))
        for i, s in enumerate(steps)
    )
    return Segmentation("made.csv", 20.0, None, spans)


def make_signals() -> Signals:
    channels = set(Signals.__dataclass_fields__) - {"t", "sd_force", "derived", "touches"}
    values = {name: np.sin(T) for name in channels}
    return Signals(t=T, **values, sd_force=0.01)


def check_picture(path) -> None:
    """A PNG file that is neither empty nor one colour."""
    picture = imread(path)
    assert min(picture.shape[:2]) > 200 and np.std(picture[..., :3]) > 0.02


def test_signals_show_subtasks_and_where_a_trial_failed(tmp_path, texts):
    path = tmp_path / "signals.png"
    draw_signals(make_signals(), make_segmentation(), path)
    check_picture(path)
    assert {"pregrasp block", "carry block", "hold-above-ground", "Grip\n[N]", "Mean $x$\n[cm]"} <= set(texts)
    segmentation = make_segmentation()
    failed = replace(segmentation, spans=segmentation.spans[:1], failed=Failure(1, "pickup", "block", "none"))
    gappy = replace(make_signals(), fx1=np.where(np.arange(100) % 2, np.nan, 1.0), x1=np.full(100, np.nan))
    draw_signals(gappy, failed, tmp_path / "failed.png")
    draw_signals(gappy, replace(failed, spans=()), tmp_path / "empty.png")
    assert "does not fit its task at pickup block" in texts
    check_picture(tmp_path / "empty.png")


def test_channels_of_a_plain_task_up_to_what_is_legible(tmp_path, texts):
    spans = tuple(replace(s, object=None, state=s.subtask) for s in make_segmentation().spans)
    trial = Trial("made.csv", T, {f"c{i}": np.cos(i * T) for i in range(MOST + 3)})
    draw_channels(trial, Segmentation("made.csv", 20.0, 1.0, spans), tmp_path / "channels.png")
    check_picture(tmp_path / "channels.png")
    assert "c11" in texts and "c12" not in texts and "pickup" in texts
    assert any("3 more channels not shown" in text for text in texts)


def test_corners_show_cm_and_predictions_their_coverage(tmp_path, texts):
    draws = np.random.default_rng(0).normal([0.343, 0.0159, 0.016], [1e-3, 1e-4, 1e-4], (2000, 3))
    actual = {"block1": {"weight": (0.5, 0.001), "width": (0.0159, 0.0001)}}
    draw_corner(draws, NAMES, tmp_path / "corner.png", actual)
    check_picture(tmp_path / "corner.png")
    assert {"block1\nwidth [cm]", "block1\nweight [N]", "lines: measured"} <= set(texts)
    assert "measured 0.5" in texts  # too far off to be a line
    draw_corner(draws[:, :1], NAMES[:1], tmp_path / "one.png")
    check_picture(tmp_path / "one.png")
    low = np.where(T > 2.5, np.nan, -0.5)
    prediction = Prediction("Net $f_y$ [N]", np.sin(T), low, low + 1.0)
    there = T <= 2.5
    assert prediction.coverage == pytest.approx(np.mean(np.sin(T[there]) <= 0.5))
    nothing = replace(prediction, low=np.full(100, np.nan))
    assert np.isnan(nothing.coverage)
    draw_predictive(T, [prediction, nothing], tmp_path / "predictive.png", make_segmentation())
    check_picture(tmp_path / "predictive.png")
    assert sum(text.endswith("% inside") for text in texts) == 1


@pytest.mark.parametrize("actual", [None, {"block1": {"weight": (0.343, 0.0005), "width": (0.0159, 0.0001)}}])
def test_estimates_with_null_and_bounded_properties(tmp_path, texts, actual):
    draw_estimates(PROPERTIES, actual, tmp_path / "estimates.png")
    check_picture(tmp_path / "estimates.png")
    assert {" not determined ", " lower bound only ", "≥ 0.50", "block1 weight"} <= set(texts)
    assert ("0.350 ± 0.010 N" if actual is None else "0.350 ± 0.010 N  (0.3430)") in texts
