"""What a robot's diagnosis leaves besides its document: history, the motion to run next, own units, Rerun."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from hmmseg.errors import InputError
from hmmseg_cli.console import Output
from hmmseg_cli.main import main
from hmmseg_cli.pages import Setting, _parameters
from hmmseg_cli.robot import show_stages
from simgap.report.robot import Course, Own, compared, history, intervals, motion_csv, write_rerun
from simgap.simulators.recording import Recording

DEGREES = Own("rad", np.pi / 180, 0.0, "deg")


def told(mean: float | None, sd: float = 0.01) -> dict:
    ends = None if mean is None else [mean - 1.645 * sd, mean + 1.645 * sd]
    return {"mean": mean, "sd": sd, "interval_90": ends, "unit": "N m"}


def test_a_history_says_what_moved_and_that_no_more_often_than_stated():
    old = {"a": told(1.0), "b": told(1.0), "c": told(1.0), "d": told(1.0)}
    past = [{"date": "2026-01-01", "parameters": old},
            {"date": "2026-02-01", "parameters": {"b": told(None)}}]  # fmt: skip
    now = {"a": told(1.01), "b": told(1.2), "c": told(1.025), "d": told(None), "new": told(1.0)}
    found = compared(past, now)
    assert {n: v["says"] for n, v in found.items()} == {"a": "within", "b": "moved", "c": "cannot tell",
                                                        "d": "cannot tell"}  # fmt: skip
    assert found["b"]["since"] == "2026-01-01" and found["b"]["then"] == 1.0
    rng = np.random.default_rng(0)
    runs = [{n: told(float(rng.normal(1, 0.01))) for n in "abcde"} for _ in range(801)]
    pairs = zip(runs[:-1:2], runs[1::2], strict=True)
    answers = [compared([{"date": "", "parameters": a}], b).values() for a, b in pairs]
    moved = sum(any(v["says"] == "moved" for v in one) for one in answers)
    assert moved <= 10  # of 400, 1 % of runs; more than 10 once in 300


@pytest.mark.parametrize("line", [
    '{"date": 3}',
    '"text"',
    '{"date": "2026-01-01", "parameters": {"a": {"mean": "1"}}}',
    '{"date": "2026-01-01", "parameters": {"a": {"mean": 1, "interval_90": 2}}}',
])  # fmt: skip
def test_a_history_that_is_none_names_its_line(tmp_path, line):
    file = tmp_path / "h.jsonl"
    assert history(file) == []
    file.write_text('{"date": "2026-01-01", "parameters": {}}\n' + line)
    with pytest.raises(InputError, match="line 2: is no run of a history"):
        history(file)


def test_what_was_named_stands_over_what_was_calibrated_and_a_model_that_flies_off_is_a_line():
    body = {"verdict": "named", "causes": ["joint:a.f"], "indistinguishable": [],
            "effects": {"joint:a.f": {"parameters": {"f": told(2.0)}},
                        "s": {"parameters": {"v": told(1.0), "w": told(4.0)}}},
            "calibrated": {"parameters": {"joint:a.f": told(1.0), "g": told(3.0)}}}  # fmt: skip
    assert {n: p["mean"] for n, p in intervals(body).items()} == {"joint:a.f": 2.0, "g": 3.0}
    found = intervals(body | {"verdict": "set", "indistinguishable": ["s"]})
    assert {n: p["mean"] for n, p in found.items()} == {"joint:a.f": None, "g": 3.0, "s.v": None, "s.w": None}
    with (Output("diagnose", quiet=True) as out,
          pytest.raises(InputError, match="runs far away from the logs"),
          show_stages(out, "diagnosing", 1)):  # fmt: skip
        np.linalg.cholesky(-np.eye(2))


def test_motions_are_written_as_logs_have_them_and_pages_in_their_units():
    log = Recording("a.csv", np.array([2.0, 2.5]), {"u": np.array([0.0, np.pi / 2]), "v": np.ones(2)})
    text = motion_csv(log, ["u", "v"], {"u": DEGREES}, ("stamp_ms", 1e-3))
    assert text == "stamp_ms,u,v\n0,0,1\n500,90,1\n"
    bias = {"mean": np.pi / 180, "sd": 1e-4, "interval_90": [0.017, 0.018], "unit": "rad", "nominal": 0.0}
    setting = Setting([], own={"q1": DEGREES})
    ((_, model, found, ends),) = _parameters({"parameters": {"bias": bias}}, ["readout:q1.bias"], setting)
    assert (model, found) == ("0 deg (0 mrad)", "1.0000 ± 0.0057 deg (17.45 ± 0.10 mrad)")
    assert ends == "0.974 to 1.031 deg (17.00 to 18.00 mrad)"
    load = {"mean": 0.09, "sd": 0.001, "interval_90": [0.088, 0.092], "unit": "kg", "nominal": 0.0}
    setting = Setting([], shows={"body:arm.payload": "a load on arm, at 300, 0, 0 mm in its frame"})
    ((words, *_),) = _parameters({"parameters": {"payload": load}}, ["body:arm.payload"], setting)
    assert words == "arm: a load at 300, 0, 0 mm in its frame"


def test_rerun_gets_three_courses_of_each_channel(tmp_path, monkeypatch):
    sent = []
    stream = SimpleNamespace(
        save=lambda path: None, flush=lambda: None,
        send_columns=lambda entity, indexes, columns: sent.append((entity, *indexes, columns)),
    )  # fmt: skip
    fake = SimpleNamespace(RecordingStream=lambda name: stream, TimeColumn=lambda name, duration: duration,
                           Scalars=SimpleNamespace(columns=lambda scalars: scalars))  # fmt: skip
    monkeypatch.setitem(sys.modules, "rerun", fake)
    t = np.array([0.0, np.nan, 1.0])
    write_rerun(tmp_path / "a.rrd", [Course("a.csv", "q", "deg", t, t, t + 1, t + 2, 1.0)])
    assert [e for e, *_ in sent] == [f"a.csv/q/{n}" for n in ("recorded", "simulated", "corrected")]
    assert [list(v) for _, _, v in sent] == [[0, 1], [1, 2], [2, 3]]
    assert all(list(index) == [0, 1] for _, index, _ in sent)


@pytest.mark.parametrize(("options", "line"), [
    (["--history", "h.jsonl"], "--history h.jsonl: goes with a model of a robot; expected --mjcf XML"),
    (["--simulator", "x.py:Y", "--history", "h.txt"], "unknown kind of file; expected .jsonl"),
    (["--simulator", "x.py:Y", "--rerun", "a.rrd"], "--rerun: needs rerun-sdk; expected pip install"),
])  # fmt: skip
def test_options_that_cannot_be_are_said_at_once(tmp_path, capsys, options, line, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "rerun", None)
    (tmp_path / "a.csv").write_text(json.dumps("t"))
    assert main(["diagnose", "a.csv", *options]) == 2 and line in capsys.readouterr().err
