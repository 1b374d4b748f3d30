"""Text tables as labs write them, against the same numbers; and those refused with their line."""

import numpy as np
import pytest

from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.io.formats import read_table
from hmmseg.io.rig import parse_rig
from hmmseg.io.task import SequenceTask

PLAIN = SequenceTask(("a", "b"), channels=("x", "f"))
T = np.arange(12) * 0.05
X = np.round(np.sin(T) * 3, 4)
F = np.round(np.cos(T) * 1234.5, 3)


def written(separator=",", decimal=".", head="t,x,f", before=(), after_header=(), comment_after=None):
    rows = [separator.join(str(v).replace(".", decimal) for v in row) for row in zip(T, X, F, strict=True)]
    if comment_after is not None:
        rows.insert(comment_after, "# a remark; with, separators")
    return "\n".join([*before, head.replace(",", separator), *after_header, *rows]) + "\n"


LAYOUTS = {
    "commas": written(),
    "semicolons": written(";"),
    "semicolons and decimal commas": written(";", ","),
    "tabs": written("\t"),
    "tabs and decimal commas": written("\t", ","),
    "spaces": written("   "),
    "comments before and between": written(";", ",", before=["# lab 3", "% 2026", ""], comment_after=4),
    "header in a comment (numpy.savetxt)": written(",", head="# t,x,f"),
    "header in a comment, spaces": written(" ", head="# t,x,f"),
    "windows line ends": written(";").replace("\n", "\r\n"),
    "quoted": written(head='"t","x","f"'),
    "trailing separators": written().replace("\n", ",\n"),
    "scientific": written().replace("0.05,", "5.0E-2,", 1),
    "empty last rows": written(";") + ";;\n\n",
    "the separator said first": "sep=;\n" + written(";", ","),
    "any separator said first": "SEP=|\n" + written("|"),
    "signs before the header and its first name": written(" ", head="# #t,x,f", before=["# lab 3, a stand"]),
    "a remark behind the header in a comment": written(head="#t,x,f", after_header=["# one, two"]),
    "separators behind the rows alone": written().replace("\n", ",\n").replace("f,\n", "f\n", 1),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_hold_the_same_numbers(tmp_path, layout):
    path = tmp_path / "a.csv"
    path.write_text(LAYOUTS[layout])
    trial = read_trial(path, task=PLAIN)
    for found, planted in ((trial.t, T), (trial.channels["x"], X), (trial.channels["f"], F)):
        np.testing.assert_allclose(found, planted, rtol=1e-12)


EVEN = "t,x,f\n" + "".join(f"{t:.2f},1,{f:.3f}\n" for t, f in zip(T, F, strict=True))
BROKEN_OFF = {
    "in a row": (written() + "0.6,1", "row 14, the last, is cut off"),
    "in a number": (EVEN + "0.6,1,12.", "row 14, the last, ends within a number"),
    "in zero bytes": (written() + "\0" * 900, "ends in zero bytes"),
}  # fmt: skip


@pytest.mark.parametrize("how", BROKEN_OFF)
def test_what_was_broken_off_is_read_as_far_as_it_goes_and_said(tmp_path, how):
    text, said = BROKEN_OFF[how]
    (tmp_path / "a.csv").write_text(text)
    trial = read_trial(tmp_path / "a.csv", task=PLAIN)
    np.testing.assert_allclose(trial.t, T)
    assert len(trial.warnings) == 1 and said in trial.warnings[0]


def test_a_last_row_without_a_line_end_is_read(tmp_path):
    (tmp_path / "a.csv").write_text(written()[:-1])
    trial = read_trial(tmp_path / "a.csv", task=PLAIN)
    assert (trial.t.size, trial.warnings) == (T.size, ())


def test_spreadsheets_unicode_text(tmp_path):
    (tmp_path / "a.txt").write_bytes(written("\t", ",").encode("utf-16"))
    np.testing.assert_allclose(read_trial(tmp_path / "a.txt", task=PLAIN).channels["f"], F)


def test_umlauts_of_spreadsheets(tmp_path):
    text = written(";", ",", before=["# Prüfstand 3: Öffnung in °"])
    (tmp_path / "a.csv").write_bytes(text.replace("f", "Öf").encode("cp1252"))
    trial = read_trial(tmp_path / "a.csv", task=SequenceTask(("a",), channels=("x", "Öf")))
    np.testing.assert_allclose(trial.channels["Öf"], F)
    (tmp_path / "a.csv").write_bytes(b"\x00\xff\x01" + text.encode("cp1252"))
    with pytest.raises(InputError, match=r"cannot be read .'utf-8' codec"):
        read_trial(tmp_path / "a.csv", task=PLAIN)


def test_a_row_of_units_is_believed(tmp_path):
    (tmp_path / "a.tsv").write_text(written("\t", after_header=["[s]\t[mm]\t[mN]"]))
    trial = read_trial(tmp_path / "a.tsv", task=PLAIN)
    np.testing.assert_allclose(trial.channels["x"], X * 1e-3)
    np.testing.assert_allclose(trial.channels["f"], F * 1e-3)
    rig = parse_rig({"columns": {"x": {"unit": "cm"}}})  # what rig.toml says goes first
    np.testing.assert_allclose(read_trial(tmp_path / "a.tsv", rig, PLAIN).channels["x"], X * 1e-2)


def test_iso_stamps(tmp_path):
    stamps = np.datetime64("2026-11-23T15:09:36.250") + (T * 1e6).astype("timedelta64[us]")
    rows = [f"{s}Z,{x},{f}" for s, x, f in zip(stamps, X, F, strict=True)]
    (tmp_path / "a.csv").write_text("\n".join(["t,x,f", *rows]))
    trial = read_trial(tmp_path / "a.csv", task=PLAIN)
    np.testing.assert_allclose(trial.t, T, atol=1e-9)
    assert trial.origin == stamps[0].astype("datetime64[ns]").astype(int)


def test_only_wanted_columns_are_read(tmp_path):
    (tmp_path / "a.csv").write_text(written())
    table = read_table(tmp_path / "a.csv", ["t", "absent"])
    assert (list(table.columns), table.names) == (["t"], ("t", "x", "f"))


REFUSED = [
    (written(";", ",").replace("1234,5", "1234.5"),
     r"row 2, column f: 1234.5 has a decimal point, others have commas; expected one kind"),
    (written(";", ",").replace("1234,5", "1.234,5"), r"row 2, column f: 1.234,5 has a decimal point"),
    (written(";", ",") + "0,6;abc;1,5\n", r"row 14, column x: abc is not a finite number"),
    (written(before=["# one", "# two"], comment_after=3).replace("0.2,", "0.2.1,", 1),
     r"row 9, column t: 0.2.1 is not a finite number"),
    (written() + '0.6,"1\n2",3\n', r"row 14: a quoted cell does not end; expected one line a row"),
    (written() + '0.6,1,"3\n0.7,1,2\n', r"row 14: a quoted cell does not end; expected one line a row"),
    (written().replace("0.05,", "2026-11-23,", 1), r"row 2, column t: 0.0 is not a date|is not a finite"),
    (written("\t").replace("\t", ",", 3), r"row \d: has \d cells; expected \d as in the header"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "line"), REFUSED)
def test_refused_with_its_line(tmp_path, text, line):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"a\.csv: ({line})") as caught:
        read_trial(path, task=PLAIN)
    assert "\n" not in str(caught.value)
