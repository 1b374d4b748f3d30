"""Trials of every kind, of other labs' columns and text tables; every one refused with its message."""

import numpy as np
import pandas as pd
import polars as pl
import pytest
from refusals import refused

from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import task_space
from hmmseg.io.formats import read_table
from hmmseg.io.rig import parse_rig
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import CARTESIAN_CHANNELS, JOINT_CHANNELS
from hmmseg.io.units import UNITS, known_unit, measures, si_factor, unit_in_name

FINGERS = {"1": {"base": [0.05, 0.17], "links": [0.12, 0.11]},
           "2": {"base": [0.21, 0.17], "links": [0.1, 0.12]}}  # fmt: skip
JOINTED = parse_rig({"fingers": FINGERS, "noise": {"angle": 2e-4, "velocity": 0.03, "force": 0.012}})
CARTESIAN = parse_rig({"noise": {"position": 1e-4, "velocity": 0.01, "force": 0.02}})
PLAIN = SequenceTask(("a", "b"))
THEIRS = {"t": ("stamp", "ns", 1, 0.0), "x1": ("left x [mm]", "mm", -1, 0.25), "y1": ("ly", "cm", 1, 0.0),
          "vx1": ("lvx", 1e-3, -1, 0.0), "fx1": ("lfx", "mN", -1, 0.1),
          "fy2": ("rfy", "kgf", 1, -0.5)}  # fmt: skip
TWO = SequenceTask(("a", "b"), channels=("x", "f"))
T = np.arange(12) * 0.05
X = np.round(np.sin(T) * 3, 4)
F = np.round(np.cos(T) * 1234.5, 3)
EVEN = "t,x,f\n" + "".join(f"{t:.2f},1,{f:.3f}\n" for t, f in zip(T, F, strict=True))


def table(channels=JOINT_CHANNELS, samples=12) -> pd.DataFrame:
    values = np.random.default_rng(0).normal(scale=0.1, size=(samples, len(channels))).round(6)
    frame = pd.DataFrame(values, columns=list(channels))
    frame.insert(0, "t", np.arange(samples) * 0.05)
    return frame


def assert_same(trial, frame):
    np.testing.assert_allclose(trial.t, frame["t"], rtol=1e-12)
    for name, values in trial.channels.items():
        np.testing.assert_allclose(values, frame[name].to_numpy(dtype=float), rtol=1e-12)


def test_every_kind_of_file_or_table_holds_the_same_trial_and_nulls_are_missing(tmp_path):
    frame = table()
    shuffled = frame[list(frame.columns[::-1])].assign(note="ignored")
    shuffled.to_csv(tmp_path / "a.csv", index=False)
    shuffled.to_parquet(tmp_path / "a.parquet", index=False)
    np.savez(tmp_path / "a.npz", **{name: frame[name].to_numpy() for name in frame})
    for name in ("a.csv", "a.parquet", "a.npz"):
        trial = read_trial(tmp_path / name, JOINTED)
        assert set(trial.channels) == set(JOINT_CHANNELS) and trial.name == name
        assert_same(trial, frame)
    assert_same(read_trial(frame.set_index(np.arange(100, 112)), JOINTED), frame)
    ours = scene()
    for make in (dict, pd.DataFrame, pl.DataFrame):
        assert_same(read_trial(make(ours), parse_rig({})), pd.DataFrame(ours))
    frame = pl.DataFrame(ours).with_columns(
        pl.when(pl.arange(pl.len()) == 3).then(None).otherwise(pl.col("fx1")).alias("fx1")
    )
    assert np.flatnonzero(np.isnan(read_trial(frame, parse_rig({})).channels["fx1"])).tolist() == [3]


def test_csv_as_spreadsheets_write_it_and_dates_that_become_seconds(tmp_path):
    frame = table()
    lines = frame.to_csv(index=True).splitlines()  # with a nameless column of row numbers
    text = "\r\n".join([lines[0].replace(",", " , "), *lines[1:5], "", *lines[5:]]) + "\r\n\r\n"
    (tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert_same(read_trial(tmp_path / "a.csv", JOINTED), frame)
    assert "t" not in read_trial(tmp_path / "a.csv", task=PLAIN).channels
    assert set(read_trial(tmp_path / "a.csv", task=PLAIN).channels) == set(JOINT_CHANNELS)
    ours = scene(10)
    stamps = np.datetime64("2026-11-23T15:00:00.5", "ns") + (ours["t"] * 1e9).astype("timedelta64[ns]")
    for t in (stamps, np.array([f"{s}Z" for s in stamps], dtype=object),
              pd.Series(stamps).dt.tz_localize("CET")):  # fmt: skip
        trial = read_trial({**ours, "t": t}, parse_rig({}))
        np.testing.assert_allclose(trial.t, ours["t"], atol=1e-12)
        assert trial.origin is not None
    assert read_trial({**ours, "t": stamps}, parse_rig({})).origin == stamps[0].astype(int)


def test_missing_cells_uneven_times_integers_and_nullable_columns(tmp_path):
    frame = table()
    frame["t"] += np.linspace(0, 0.04, 12) ** 2
    frame.loc[3, "fx1"] = np.nan
    text = frame.to_csv(index=False, na_rep="").splitlines()
    cells = text[6].split(",")
    cells[2] = "NaN"
    text[6] = ",".join(cells)
    (tmp_path / "a.csv").write_text("\n".join(text))
    trial = read_trial(tmp_path / "a.csv", JOINTED)
    frame.loc[5, "q12"] = np.nan
    assert_same(trial, frame)
    signals = task_space(trial, JOINTED)
    assert np.isnan(signals.fx[3]) and np.isnan(signals.x[5]) and np.isfinite(signals.fy[[3, 5]]).all()
    frame = table()
    frame["fx1"] = pd.array([1, None] * 6, dtype="Int64")
    frame["fy1"] = 2
    trial = read_trial(frame, JOINTED)
    np.testing.assert_array_equal(trial.channels["fx1"], [1, np.nan] * 6)
    np.testing.assert_array_equal(trial.channels["fy1"], 2.0)


def test_a_plain_task_has_its_own_or_mapped_channels_and_refuses_others():
    frame = table(("fx", "fy", "note"))
    assert set(read_trial(frame, task=PLAIN).channels) == {"fx", "fy", "note"}
    assert set(read_trial(frame, task=SequenceTask(("a",), channels=("fy",))).channels) == {"fy"}
    with pytest.raises(InputError, match="DataFrame: has no columns but t; expected at least one channel"):
        read_trial(table(()), task=PLAIN)
    with pytest.raises(InputError, match="DataFrame: column fz: missing; expected one of fx, fy, t"):
        read_trial(table(("fx", "fy")), task=SequenceTask(("a",), channels=("fz",)))
    with pytest.raises(ValueError, match="a block task's trial needs its rig"):
        read_trial(table())
    theirs = {"stamp": np.arange(10) * 20.0, "F": np.arange(10.0), "other": np.ones(10)}
    rig = parse_rig({"columns": {"t": {"from": "stamp", "unit": "ms"}, "force": {"from": "F", "unit": "mN"}}})
    trial = read_trial(theirs, rig, PLAIN)
    assert sorted(trial.channels) == ["force", "other"] and trial.rate == pytest.approx(50.0)
    np.testing.assert_allclose(trial.channels["force"], np.arange(10) * 1e-3)


def csv(change):
    lines = table().to_csv(index=False).splitlines()
    return "\n".join(change(lines))


def cell(row, column, text):
    def change(lines):
        cells = lines[row - 1].split(",")
        cells[("t", *JOINT_CHANNELS).index(column)] = text
        return [*lines[:row - 1], ",".join(cells), *lines[row:]]  # fmt: skip

    return csv(change)  # fmt: skip


REFUSED_CSV = [("", "column t: missing; expected a header row with a column t of times in s"),
               (csv(lambda lines: lines[1:]), "column t: missing; expected a header row"),
               (csv(lambda lines: [lines[0].replace("fx1", "fz1"), *lines[1:]]),
                "column fx1: missing; expected t, q"),
               (csv(lambda lines: [lines[0].replace("fx1", "q11"), *lines[1:]]), "column q11: appears twice"),
               (csv(lambda lines: lines[:8]), "has 7 samples; expected at least 8"),
               (csv(lambda lines: lines[:1]), "has 0 samples; expected at least 8"),
               (csv(lambda lines: [*lines[:4], lines[4] + ",1,2", *lines[5:]]),
                "row 5: has 15 cells; expected 13 as in the header"),
               (csv(lambda lines: [lines[0], *(line + ",1" for line in lines[1:])]),
                "row 2: has 14 cells; expected 13"), (csv(lambda lines: [*lines[:6], "0.55,0.3", *lines[6:]]),
                                                      "row 7: has 2 cells; expected 13 as in the header"),
               (cell(5, "fy2", "x"),
                "row 5, column fy2: x is not a finite number; expected a number or an empty cell"),
               (cell(5, "fy2", "inf"), "row 5, column fy2: inf is not a finite number"),
               (cell(5, "fy2", "0.1.2"), "row 5, column fy2: 0.1.2 is not a finite number"),
               (cell(2, "t", "soon"), "row 2, column t: soon is not a finite number"),
               (cell(4, "t", ""), "row 4, column t: missing; expected a time in s"),
               (cell(4, "t", "0.05"), "row 4, column t: 0.05 after 0.05; expected strictly increasing times"),
               (cell(4, "t", "1700000000.1"), "row 5, column t: 0.15 after 1700000000.1; expected strictly"),
               (cell(4, "t", "-1"), "row 4, column t: -1 after 0.05; expected strictly increasing"),
               ("\n" + csv(lambda lines: lines[1:]), "column t: missing; expected a header row"),
               (csv(lambda lines: [*lines[:4], "", "", cell(5, "q11", "?").splitlines()[4], *lines[5:]]),
                r"row 7, column q11: \? is not a finite number")]  # fmt: skip


@pytest.mark.parametrize(("frame", "message"), [
    (table().assign(fx1=np.nan), "DataFrame: column fx1: has no values; expected at least one number"),
    (table().assign(fx1=["a"] * 12), "DataFrame: row 1, column fx1: a is not a finite number"),
    (table().assign(fx1=pd.Timestamp("2020-01-01")),
     r"DataFrame: column fx1: holds datetime64.*; expected numbers"),
    (table().assign(fx1=True), "DataFrame: column fx1: holds bool; expected numbers"),
    (table().assign(fx1=1j), "DataFrame: column fx1: holds complex128; expected numbers"),
    (table().rename(columns={"fx1": "q11"}), "DataFrame: column q11: appears twice; expected one of each"),
    (table().drop(columns="t"), "DataFrame: column t: missing"),
    (pd.DataFrame(), "DataFrame: column t: missing"),
    (table().assign(fy2=[0.1] * 3 + [-1e300] + [0.1] * 8),
     r"DataFrame: row 4, column fy2: -1e\+300 is no reading of a hand's sensor"),
    (table().assign(t=[*np.arange(11) * 0.05, 1e200]),
     r"DataFrame: .*column t: 1e\+200 is no time; expected a time in s")])  # fmt: skip
def test_dataframe_refused_with_its_message(frame, message):
    refused(f"^{message}", read_trial, frame, JOINTED)


def test_files_refused(tmp_path):
    for name, content, message in [
        ("a.doc", b"t\n", r"a\.doc: unknown kind of file '.doc'; expected .csv, .tsv, "),
        ("a.csv", b"t,\x00\xe9\n", r"a\.csv: cannot be read .*; expected a table with a header row"),
        ("a.parquet", b"not parquet", r"a\.parquet: cannot be read "),
        ("a.npz", b"not npz", r"a\.npz: is no archive of NumPy"),
        ("b.npz", b"", r"b\.npz: is no archive of NumPy"),
        ("c.npz", b"PK\x03\x04 cut off", r"c\.npz: is no archive of NumPy"),
    ]:
        (tmp_path / name).write_bytes(content)
        refused(message, read_trial, tmp_path / name, JOINTED)
    (tmp_path / "folder.csv").mkdir()
    refused(r"folder\.csv: is a folder; expected a trial", read_trial, tmp_path / "folder.csv", JOINTED)
    refused(r"absent\.csv: no such file; expected a trial", read_trial, tmp_path / "absent.csv", JOINTED)
    np.savez(tmp_path / "uneven.npz", t=np.arange(9), q11=np.arange(8))
    with pytest.raises(InputError, match=r"uneven\.npz: column .*: has . rows; expected . as in the"):
        read_trial(tmp_path / "uneven.npz", JOINTED)
    with (tmp_path / "one.npz").open("wb") as file:
        np.save(file, np.arange(9))
    refused(r"one\.npz: holds one array without a name; expected one array a column", read_trial,
            tmp_path / "one.npz", JOINTED)  # fmt: skip


def scene(samples: int = 40) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    columns = {name: rng.uniform(-0.1, 0.1, samples) for name in CARTESIAN_CHANNELS}
    columns["x2"] = columns["x2"] + 0.3
    return {"t": np.arange(samples) * 0.02, **columns}


def test_mapping_is_undone_by_units_sign_and_offset_and_fits_the_file():
    ours = scene()
    theirs = dict(ours)
    for name, (source, unit, sign, offset) in THEIRS.items():
        theirs[source] = (theirs.pop(name) - offset) * sign / (si_factor(unit) if isinstance(unit, str)
                                                               else unit)  # fmt: skip
    theirs["name alone"] = theirs.pop("y2")
    rig = parse_rig({"columns": {
        name: {"from": source, "unit": unit, "sign": sign, "offset": offset}
        for name, (source, unit, sign, offset) in THEIRS.items()
    } | {"y2": "name alone"}})  # fmt: skip
    trial = read_trial(theirs, rig)
    np.testing.assert_allclose(trial.t, ours["t"], atol=1e-12)
    for name in CARTESIAN_CHANNELS:
        np.testing.assert_allclose(trial.channels[name], ours[name], atol=1e-12, err_msg=name)
    with pytest.raises(InputError, match=r"column left: missing, but the rig maps x1 to it; expected one of"):
        read_trial(ours, parse_rig({"columns": {"x1": "left"}}))
    with pytest.raises(InputError, match=r"\[columns\] xl: is no channel of this hand or task; .*mean"):
        read_trial(ours, parse_rig({"columns": {"xl": "x1"}}))


def test_units():
    assert si_factor("mm") == 1e-3 and known_unit("Milliseconds") == "ms" and known_unit("N m") == "Nm"
    assert known_unit("parsec") is None
    for name in UNITS:
        assert known_unit(name) == name
    assert [measures(c) for c in ("t", "x1", "vy2", "fx1", "q12", "dq21", "force")] == [
        "time", "length", "velocity", "force", "angle", "angular velocity", None]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "unit"),
    [("left_x_mm", "mm"), ("force [N]", "N"), ("t (ms)", "ms"), ("angle [°]", "deg"), ("time_ns", "ns"),
     ("x1", None), ("speed_mm/s", "mm/s"), ("finger_left", None), ("state[3]", None)])  # fmt: skip
def test_unit_in_a_name(name, unit):
    assert unit_in_name(name) == unit


def written(separator=",", decimal=".", head="t,x,f", before=(), after_header=(), comment_after=None):
    rows = [separator.join(str(v).replace(".", decimal) for v in row) for row in zip(T, X, F, strict=True)]
    if comment_after is not None:
        rows.insert(comment_after, "# a remark; with, separators")
    return "\n".join([*before, head.replace(",", separator), *after_header, *rows]) + "\n"


LAYOUTS = {"commas": written(), "semicolons": written(";"),
           "semicolons and decimal commas": written(";", ","), "tabs": written("\t"),
           "tabs and decimal commas": written("\t", ","), "spaces": written("   "),
           "comments before and between": written(";", ",", before=["# lab 3", "% 2026", ""],
                                                  comment_after=4),
           "header in a comment (numpy.savetxt)": written(",", head="# t,x,f"),
           "header in a comment, spaces": written(" ", head="# t,x,f"),
           "windows line ends": written(";").replace("\n", "\r\n"), "quoted": written(head='"t","x","f"'),
           "trailing separators": written().replace("\n", ",\n"),
           "scientific": written().replace("0.05,", "5.0E-2,", 1), "empty last rows": written(";") + ";;\n\n",
           "the separator said first": "sep=;\n" + written(";", ","),
           "any separator said first": "SEP=|\n" + written("|"),
           "signs before the header and its first name": written(" ", head="# #t,x,f",
                                                                 before=["# lab 3, a stand"]),
           "a remark behind the header in a comment": written(head="#t,x,f", after_header=["# one, two"]),
           "separators behind the rows alone": written().replace("\n", ",\n").replace("f,\n", "f\n", 1),
           "no line end after the last row": written()[:-1],
           "a spreadsheet's Unicode text": written("\t", ",").encode("utf-16")}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_hold_the_same_numbers(tmp_path, layout):
    path, text = tmp_path / "a.csv", LAYOUTS[layout]
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    trial = read_trial(path, task=TWO)
    for found, planted in ((trial.t, T), (trial.channels["x"], X), (trial.channels["f"], F)):
        np.testing.assert_allclose(found, planted, rtol=1e-12)
    assert trial.warnings == ()


BROKEN_OFF = {"in a row": (written() + "0.6,1", "row 14, the last, is cut off"),
              "in a number": (EVEN + "0.6,1,12.", "row 14, the last, ends within a number"),
              "in zero bytes": (written() + "\0" * 900, "ends in zero bytes")}  # fmt: skip


@pytest.mark.parametrize("how", BROKEN_OFF)
def test_what_was_broken_off_is_read_as_far_as_it_goes_and_said(tmp_path, how):
    text, said = BROKEN_OFF[how]
    (tmp_path / "a.csv").write_text(text)
    trial = read_trial(tmp_path / "a.csv", task=TWO)
    np.testing.assert_allclose(trial.t, T)
    assert len(trial.warnings) == 1 and said in trial.warnings[0]


def test_umlauts_and_units_of_spreadsheets_are_read_and_words_are_no_channel(tmp_path):
    text = written(";", ",", before=["# Prüfstand 3: Öffnung in °"])
    (tmp_path / "a.csv").write_bytes(text.replace("f", "Öf").encode("cp1252"))
    trial = read_trial(tmp_path / "a.csv", task=SequenceTask(("a",), channels=("x", "Öf")))
    np.testing.assert_allclose(trial.channels["Öf"], F)
    (tmp_path / "a.csv").write_bytes(b"\x00\xff\x01" + text.encode("cp1252"))
    refused(r"cannot be read .'utf-8' codec", read_trial, tmp_path / "a.csv", task=TWO)
    (tmp_path / "a.tsv").write_text(written("\t", after_header=["[s]\t[mm]\t[mN]"]))
    trial = read_trial(tmp_path / "a.tsv", task=TWO)
    np.testing.assert_allclose(trial.channels["x"], X * 1e-3)
    np.testing.assert_allclose(trial.channels["f"], F * 1e-3)
    rig = parse_rig({"columns": {"x": {"unit": "cm"}}})  # what rig.toml says goes first
    np.testing.assert_allclose(read_trial(tmp_path / "a.tsv", rig, TWO).channels["x"], X * 1e-2)
    frame = pd.DataFrame({"t": T, "x": np.sin(T), "note": "fine", "when": pd.Timestamp("2026-01-01")})
    frame.to_csv(tmp_path / "a.csv", index=False)
    for source in (tmp_path / "a.csv", frame.drop(columns="when")):
        trial = read_trial(source, task=SequenceTask(("a", "b")))
        assert set(trial.channels) == {"x"}
        assert any("column note holds text, and is left out" in line for line in trial.warnings)
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
    (written("\t").replace("\t", ",", 3), r"row \d: has \d cells; expected \d as in the header")]  # fmt: skip


@pytest.mark.parametrize(("text", "line", "read"),
                         [*((*each, {"rig": JOINTED}) for each in REFUSED_CSV),
                          *((*each, {"task": TWO}) for each in REFUSED)])  # fmt: skip
def test_csv_refused_with_its_line(tmp_path, text, line, read):
    path = tmp_path / "a.csv"
    path.write_text(text)
    refused(rf"a\.csv: ({line})", read_trial, path, **read)
