"""`hmmseg watch` end to end: rows in, lines out, one clear line for what cannot be read."""

import io
import json
import re
import sys
from datetime import datetime, timedelta
from pathlib import Path

import pytest
from rich.console import Console

from hmmseg import Watcher
from hmmseg_cli.main import main
from hmmseg_cli.watch import Live, picture, spark

CASE = Path(__file__).parents[2] / "recordings" / "paper_blocks"
ROWS = (CASE / "trial_01.csv").read_text().splitlines()
COMMAND = ["watch", "--task", str(CASE / "task.toml"), "--rig", str(CASE / "rig.toml")]


@pytest.fixture
def run(monkeypatch, capsys):
    def run(rows, *options, end="\n"):
        text = io.TextIOWrapper(io.BytesIO(("\n".join(rows) + end).encode()))
        monkeypatch.setattr(sys, "stdin", text)
        code = main([*COMMAND, *options])
        out, err = capsys.readouterr()
        return code, [json.loads(line) for line in out.splitlines()], err

    return run


def test_one_line_a_row_and_a_last_one_or_a_live_picture_of_where_the_task_is(run, tmp_path):
    code, lines, err = run(ROWS, "--json", str(tmp_path / "out.json"))
    assert code == 0 and err == ""
    assert len(lines) == len(ROWS)  # the header's place is taken by the last line
    assert [line["t"] for line in lines[:3]] == [0, 0.05, 0.1]
    assert lines[-1]["final"] and lines[-1]["fits"] and lines[-1]["format"] == "hmmseg.watch/1"
    assert [s["subtask"] for s in lines[-1]["segments"]][:3] == ["pregrasp", "pickup", "carry"]
    assert json.loads((tmp_path / "out.json").read_text())["segments"] == lines[-1]["segments"]
    watcher = Watcher(COMMAND[2], COMMAND[4])
    live = Live(watcher)
    live._console.file = io.StringIO()
    for row in ROWS[1:60]:
        t, *values = map(float, row.split(","))
        answer = watcher.update(t, values)
        live.update(answer)
    live.close()
    console = Console(file=io.StringIO(), width=140)
    console.print(picture(watcher, answer, list(live._kept), ["a note"]))
    text = console.file.getvalue()
    assert "carry block1" in text and "fits its task" in text and "a note" in text and "grip" in text
    assert spark([0.0, float("nan"), 2.0]) == "▁ █ 2.00 N at most"


@pytest.mark.parametrize(("change", "message"), [
    (lambda rows: [rows[0].replace("fx1", "fz1"), *rows[1:]], "column fx1: missing"),
    (lambda rows: [*rows[:5], rows[5].replace(",", ",x", 1), *rows[6:]], "row 6, column q11: 'x"),
    (lambda rows: [*rows[:5], "1,2,3", *rows[6:]], "row 6: has 3 cells; expected 13"),
    (lambda rows: [*rows[:5], "," + rows[5].split(",", 1)[1], *rows[6:]], "row 6, column t: missing"),
    (lambda rows: [], "standard input: is empty"),
    (lambda rows: rows[:1], "the stream: has no rows; expected a row for every sample"),
    (
        lambda rows: [*rows[:5], re.sub(",[^,]*$", ",1e300", rows[5]), *rows[6:]],
        "row 6, column fy2: 1e+300 is no")])  # fmt: skip
def test_bad_input_gets_one_line(run, change, message):
    code, _, err = run(change(ROWS[:10]))
    assert code == 2 and len(err.splitlines()) == 1 and message in err


def test_degrees_and_ms_are_refused_as_in_a_file(run):
    cells = [row.split(",") for row in ROWS[1:110]]
    angles = [k for k, name in enumerate(ROWS[0].split(",")) if name[0] in "qd"]
    rows = [",".join(str(57.3 * float(c)) if k in angles else c for k, c in enumerate(row)) for row in cells]
    code, _, err = run([ROWS[0], *rows])
    assert code == 2 and "it looks like deg; expected q" in err
    wild = [*ROWS[:60], ",".join([ROWS[60].split(",")[0], *["999"] * 12]), *ROWS[61:110]]
    assert run(wild)[0] == 0  # a single row is no unit
    cells = [row.split(",", 1) for row in ROWS[1:110]]
    rows = [f"{1e3 * float(t):g},{rest}" for t, rest in cells]
    code, _, err = run([ROWS[0], *rows])
    assert code == 2 and "it looks like ms; expected t = {" in err and 'unit = "ms"' in err
    assert run([*ROWS[:50], *ROWS[90:150]])[0] == 0  # a gap is no unit


def test_a_stream_as_a_spreadsheet_has_it(run):
    plain, table = run(ROWS[:60])[1], [row.split(",") for row in ROWS[:60]]
    units = ["" if name == "t" else "N" if name[0] == "f" else "rad/s" if name[0] == "d" else "rad"
             for name in table[0]]  # fmt: skip
    start = datetime.fromisoformat("2026-03-02T10:15:30+01:00")
    rows = ["# Versuch 3", ";".join(table[0]), ";".join(units), ""]
    for cells in table[1:]:
        stamp = (start + timedelta(seconds=float(cells[0]))).isoformat()
        rows += [";".join([stamp, *(cell.replace(".", ",") for cell in cells[1:])]), "% weiter"]
    code, lines, err = run(rows)
    assert (code, err) == (0, "")
    assert [line["probabilities"] for line in lines] == [line["probabilities"] for line in plain]
    assert lines[30]["t"] == pytest.approx(plain[30]["t"])
    code, _, err = run([*rows[:10], rows[10].replace("2026", "morgen"), *rows[11:]])
    assert code == 2 and "column t: 'morgen" in err


@pytest.mark.parametrize("left_out", [r"\[fingertip\][^\[]*", r"(?m)^(normal|shear)_stiffness.*$"])
def test_a_rig_without_pads_is_told(run, tmp_path, left_out):
    (tmp_path / "rig.toml").write_text(re.sub(left_out, "", (CASE / "rig.toml").read_text()))
    code, lines, _ = run(ROWS[:20], "--rig", str(tmp_path / "rig.toml"))
    assert code == 0 and any("states no [fingertip]" in line for line in lines[-1]["warnings"])


def test_bad_rows_and_one_that_breaks_off_can_be_left_out(run):
    rows = [*ROWS[:5], "garbage", *ROWS[5:20]]
    code, lines, err = run(rows, "--skip-bad-rows")
    assert code == 0 and len(lines) == 20 and "row 6: has 1 cells" in err and lines[-1]["counts"]["bad"] == 1
    code, lines, err = run([*ROWS[:20], ROWS[20][:30]], end="")
    assert code == 0 and len(lines) == 20 and lines[-1]["final"] and lines[-1]["counts"]["rows"] == 19
    assert lines[-1]["warnings"] == ["standard input: row 21, the last, is cut off and left out"]
    assert lines[-1]["warnings"][0] in err
    whole = run(ROWS[:20], end="")[1]
    assert whole[-1]["counts"] == lines[-1]["counts"] and whole[-1]["segments"] == lines[-1]["segments"]
