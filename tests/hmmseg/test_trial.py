"""Trials, rigs and tasks of every layout, each refused with its message; tasks decomposed against physics."""

import math
from fractions import Fraction

import numpy as np
import pandas as pd
import polars as pl
import pytest
from hand_signals import JOINTED
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from scipy.linalg import null_space

from hmmseg.contact import decompose as decomposing
from hmmseg.contact.decompose import Source, decompose, determined, height_equations
from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import task_space
from hmmseg.io.formats import read_table
from hmmseg.io.rig import Rig, parse_rig, read_rig
from hmmseg.io.task import GROUND, BlockTask, Move, SequenceTask, parse_task, read_task
from hmmseg.io.trial import CARTESIAN_CHANNELS, JOINT_CHANNELS
from hmmseg.io.units import UNITS, known_unit, measures, si_factor, unit_in_name

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
    gone = pl.when(pl.arange(pl.len()) == 3).then(None).otherwise(pl.col("fx1")).alias("fx1")
    frame = pl.DataFrame(ours).with_columns(gone)
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
    line = "DataFrame: has no columns but t; expected at least one channel"
    refused(line, read_trial, table(()), task=PLAIN)
    refused("DataFrame: column fz: missing; expected one of fx, fy, t", read_trial, table(("fx", "fy")),
            task=SequenceTask(("a",), channels=("fz",)))  # fmt: skip
    refused("a block task's trial needs its rig", read_trial, table(), error=ValueError)
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
               (csv(lambda lines: [*lines[:6], "0.55,0.3", *lines[6:]]), "row 7: has 2 cells; expected 13"),
               (cell(5, "fy2", "x"),
                "row 5, column fy2: x is not a finite number; expected a number or an empty cell"),
               (cell(5, "fy2", "inf"), "row 5, column fy2: inf is not a finite number"),
               (cell(2, "t", "soon"), "row 2, column t: soon is not a finite number"),
               (cell(4, "t", ""), "row 4, column t: missing; expected a time in s"),
               (cell(4, "t", "0.05"), "row 4, column t: 0.05 after 0.05; expected strictly increasing times"),
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
    line = r"uneven\.npz: column .*: has . rows; expected . as in the"
    refused(line, read_trial, tmp_path / "uneven.npz", JOINTED)
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
    for mapped, line in (
        ({"x1": "left"}, "column left: missing, but the rig maps x1 to it; expected one of"),
        ({"xl": "x1"}, r"\[columns\] xl: is no channel of this hand or task; .*mean"),
    ):
        refused(line, read_trial, ours, parse_rig({"columns": mapped}))


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
    (written().replace("0.05,", "2026-11-23,", 1), r"row 2, column t: 0.0 is not a date|is not a finite"),
    (written("\t").replace("\t", ",", 3), r"row \d: has \d cells; expected \d as in the header")]  # fmt: skip


@pytest.mark.parametrize(("text", "line", "read"),
                         [*((*each, {"rig": JOINTED}) for each in REFUSED_CSV),
                          *((*each, {"task": TWO}) for each in REFUSED)])  # fmt: skip
def test_csv_refused_with_its_line(tmp_path, text, line, read):
    path = tmp_path / "a.csv"
    path.write_text(text)
    refused(rf"a\.csv: ({line})", read_trial, path, **read)


FINGER = {"base": [0.05, 0.17], "links": [0.12, 0.12]}
HAND = {"fingers": {"1": FINGER, "2": {**FINGER, "base": [0.21, 0.17]}}}
STACK = {"block1": {"on": "block2"}, "block2": {"on": "ground"}}
SWAP = [{"object": "block1", "to": "ground"}, {"object": "block2", "to": "block1"}]
BACK = [{"object": "a", "to": "b"}, {"object": "a", "to": "ground"}]
GRIPPERS = [
    ({"frame": "base"}, "key gripper.frame: "),
    ({"wrench": ["fx"]}, "key gripper.wrench: has 1 columns; expected 3 forces"),
    ({"mass": 1}, r"key gripper.mass: unknown key; .*tool_mass\?"),
    ({"sensor_axes": ["x", "y", "-z"]}, ".*gripper.sensor_axes: x, y, -z are no right-handed axes"),
    ({"position": {"x": "a", "y": "b"}}, ".*position has no column for z, the axis that is up"),
    ({"force_per_ampere": 3.0}, ".*force_per_ampere without motor_current"),
    ({"grip_force": 1e308}, "key gripper.grip_force")]  # fmt: skip


def test_uncertainty_gripper_and_tolerance_are_read_and_what_is_left_out_has_its_default():
    rig = parse_rig({})
    assert rig == Rig() and not rig.jointed and rig.gravity == 9.80665
    assert math.isinf(rig.fingertip.normal_stiffness) and rig.noise.force is None
    refused("a Cartesian hand has no fingers", rig.finger, 1, error=ValueError)
    rig = parse_rig({"systematic": {"force_bias": 0.01, "force_gain": [0.1, 0.2, 0.3, 0.4],
                                    "joint_offset": {"q12": 0.002}, "pad_stiffness": 1}})  # fmt: skip
    assert rig.systematic.force_bias == (0.01,) * 4 and rig.systematic.force_gain == (0.1, 0.2, 0.3, 0.4)
    assert rig.systematic.joint_offset == (0.0, 0.002, 0.0, 0.0)
    assert rig.systematic.pad_stiffness == (1.0, 1.0) and rig.systematic.link_length == (0.0,) * 4
    rig = parse_rig({"tolerance": {"position": 1e-3}, "gripper": {"opening": "width", "tool_mass": 0.5}})
    assert (rig.tolerance.position, rig.tolerance.property) == (1e-3, None)
    assert rig.gripper.channels[:4] == ("x", "y", "z", "width") and rig.gripper.tool_mass == 0.5


REFUSED_RIGS = [
    ({"speed": 1}, r"key speed: unknown key; expected one of .*rate.* \(did you mean"),
    ({"fingers": {"1": {**FINGER, "length": 1}, "2": FINGER}}, "key fingers.1.length: unknown key"),
    ({"fingers": {"1": FINGER}}, r"fingers must be the two tables \[fingers.1\] and \[fingers.2\]"),
    ({"fingers": {"1": FINGER, "2": {"base": [0, 0]}}}, "key fingers.2.links: missing"),
    ({"fingers": {"1": FINGER, "2": {**FINGER, "links": [0.1, -0.1]}}}, "key .*2.links.1: .*greater than 0"),
    ({"fingers": {"1": FINGER, "2": {**FINGER, "base": [0.1, math.nan]}}}, "key fingers.2.base.1: .*finite"),
    ({"rate": 0}, r"key rate: Input should be greater than 0 \(found 0"),
    ({"rate": True}, r"key rate: Input should be a valid number \(found True\)"),
    ({"gravity": 980.665}, r"key gravity: .*less than or equal to 100"),
    ({"fingers": {"1": FINGER, "2": {**FINGER, "links": [120, 120]}}}, "key .*2.links.0: .*equal to 10"),
    ({"fingertip": {"normal_stiffness": math.nan}}, r"key fingertip.normal_stiffness: .*greater than 0"),
    ({"noise": {"force": 0}}, r"key noise.force: .*greater than 0"),
    ({"noise": 0.1}, r"key noise: .*dictionary"),
    ({"systematic": {"force_bias": -0.1}}, r"key systematic.force_bias.0: .*greater than or equal to 0"),
    ({"systematic": {"force_bias": [0.1, 0.1]}}, r"key systematic.force_bias.2: missing"),
    ({"systematic": {"force_bias": {"fz1": 0.1}}}, "key systematic.force_bias: unknown entry fz1; .*mean f"),
    ({"systematic": {"force_bias": True}}, r"key systematic.force_bias: must be a number"),
    ({"systematic": {"force_bias": 10**400}}, r"key systematic.force_bias: must be at most 1e\+12"),
    ({"columns": {"x1": {"from": "a", "unit": "furlong"}}}, "key columns.x1.unit: unknown unit 'furlong'"),
    ({"columns": {"x1": {"from": "a", "sing": 1}}}, r"key columns.x1.sing: unknown key; .*mean sign\?"),
    ({"columns": {"x1": {"from": "a", "sign": 2}}}, "key columns.x1.sign: found 2; expected 1 or -1"),
    ({"columns": {"x1": {"from": ""}}}, "key columns.x1.from: .*at least 1 character"),
    ({"columns": {"x1": 3}}, "key columns.x1: "),
    ({"columns": {"x1": {"unit": -1.0}}}, "key columns.x1.unit"),
    ({"columns": {"t": {"unit": "mm"}}}, "key columns: t is a time, but its unit mm is one of length"),
    ({"columns": {"fx1": {"unit": "deg"}}}, "key columns: fx1 is a force, but its unit deg is one of angle"),
    ({"gripper": {}}, r"a hand has \[fingers\] or is a \[gripper\], not both")]  # fmt: skip


@pytest.mark.parametrize(("table", "message"), [
    *(({**HAND, **table}, message) for table, message in REFUSED_RIGS),
    *(({"gripper": table}, message) for table, message in GRIPPERS)])  # fmt: skip
def test_refused_with_its_message(table, message):
    refused(f"^rig: {message}", parse_rig, table)


def test_reads_blocks_moves_repeats_and_plain_sequences(tmp_path):
    path = tmp_path / "task.toml"
    path.write_text('[objects.block1]\non = "block2"\n[objects.block2]\non = "ground"\n'
                    '[[moves]]\nobject = "block1"\nto = "ground"\n'
                    '[[moves]]\nobject = "block1"\nto = "ground"\nslide = true\n')  # fmt: skip
    task = read_task(path)
    assert task == BlockTask({"block1": "block2", "block2": "ground"},
                             (Move("block1", "ground"), Move("block1", "ground", slide=True)))  # fmt: skip
    assert task.objects == ("block1", "block2")
    table = {"objects": {"a": {"on": "ground"}, "b": {"on": "ground"}}, "moves": BACK, "repeat": 3}
    task = parse_task(table)
    assert isinstance(task, BlockTask) and task.performed == task.moves * 3
    unknown = parse_task({**table, "repeat": "unknown"})
    assert isinstance(unknown, BlockTask) and unknown.performed == unknown.moves
    table = {"sequence": ["a", "b", "a"], "channels": ["fx"], "optional": ["b"]}
    assert parse_task(table) == SequenceTask(("a", "b", "a"), ("fx",), ("b",))
    assert parse_task({"sequence": ["a"]}) == SequenceTask(("a",))


def blocks(objects=STACK, moves=SWAP, **more):
    return {"objects": objects, "moves": moves, **more}


def move(**entry):
    return blocks(moves=[entry])


@pytest.mark.parametrize(("table", "message"), [
    (blocks(move=[]), r"key move: unknown key; expected one of .*, sequence \(did you mean moves\?\)"),
    (blocks(sequence=["a"]), "key moves: does not go with `sequence`"),
    (blocks(channels=["fx"]), "key channels: goes only with `sequence`"),
    ({}, r"key objects: missing or empty; expected a table \[objects.NAME\] for every block"),
    (blocks(objects=["block1"]), "key objects: missing or empty"),
    ({"objects": STACK}, r"key moves: missing or empty; expected at least one \[\[moves\]\]"),
    (blocks(moves={"object": "block1"}), "key moves: missing or empty"),
    (blocks(objects={"ground": {"on": "ground"}}), "key objects.ground: 'ground' is always there"),
    (blocks(objects={"my block": {"on": "ground"}}), "key .*'my block' cannot be a name; expected letters"),
    (blocks(objects={"a": {}}), "key objects.a.on: missing; expected what the object stands on"),
    (blocks(objects={"a": "ground"}), "key objects.a.on: missing"),
    (blocks(objects={"a": {"on": "ground", "mass": 1}}), "key objects.a.mass: unknown key"),
    (blocks(objects={"a": {"on": "grund"}}), r"key objects.a.on: unknown object 'grund'; .*ground"),
    (blocks(objects={"a": {"on": ["ground"]}}), r"key objects.a.on: unknown object \['ground'\]"),
    (blocks(objects={"a": {"on": "a"}}), "key objects.a.on: objects stand on each other in a circle"),
    (blocks(objects={"a": {"on": "c"}, "b": {"on": "c"}, "c": {"on": "ground"}}), ".*c' already carries 'a"),
    (blocks(repeat=0), 'key repeat: found 0; expected a whole number from 1 to 1000 or "unknown"'),
    (blocks(repeat=True), "key repeat: found True"),
    (blocks(repeat=10**9), "key repeat: found 1000000000"),
    (blocks(moves=["block1"]), "move 1: found 'block1'; expected a table with object and to"),
    (move(object="block1", too="ground"), "move 1: key too: unknown key; .*did you mean to"),
    (move(object="block1"), "move 1: key to: missing or not a name; expected an object's name"),
    (move(to="ground"), "move 1: key object: missing or not a name"),
    (move(object="block1", to="ground", slide=1), "move 1: key slide: found 1; expected true or false"),
    (move(object="block3", to="ground"), "move 1: unknown object 'block3'; expected one of block1"),
    (move(object="block1", to="table"), "move 1: unknown destination 'table'; expected .*ground"),
    (move(object="block1", to="block1"), "move 1: 'block1' cannot go onto itself"),
    (move(object="block2", to="ground"), "move 1: 'block2' has 'block1' on it; expected a free object"),
    (blocks({**STACK, "c": {"on": "ground"}}, [{"object": "c", "to": "block2"}]), ".*block2' already has"),
    (blocks(moves=[*SWAP, {"object": "block1", "to": "ground"}]), "move 3: 'block1' has 'block2'"),
    (move(object="block1", to="ground", slide=True), r"move 1: a slide stays on its support \('block2'\)"),
    (blocks(repeat=2), r"move 1 \(repeat 2\): 'block1' has 'block2' on it"),
    (blocks(repeat="unknown"), r"move 1 \(repeat 2\): 'block1' has 'block2' on it"),
    ({"sequence": []}, "key sequence: is empty; expected at least one name"),
    ({"sequence": "a"}, "key sequence: found 'a'; expected a list of names"),
    ({"sequence": ["a", 2]}, r"key sequence: found \['a', 2\]; expected a list of names"),
    ({"sequence": ["a", ""]}, "key sequence: found .*; expected a list of names"),
    ({"sequence": ["a", "b", "b"]}, "key sequence: entries 2 and 3 are both 'b'; expected"),
    ({"sequence": ["a"], "channels": []}, "key channels: empty or repeated"),
    ({"sequence": ["a"], "channels": ["f", "f"]}, "key channels: empty or repeated; expected distinct"),
    ({"sequence": ["a", "b"], "optional": ["c"]}, "key optional: 'c' is not in sequence; .* a, b"),
    ({"sequence": ["a", "b"], "optional": ["a", "b"]}, "key optional: covers all of sequence"),
])  # fmt: skip
def test_a_task_refused_with_its_message(table, message):
    refused(f"^task: {message}", parse_task, table)


@pytest.mark.parametrize("read", [read_rig, read_task])
def test_a_file_that_is_absent_or_malformed(read, tmp_path):
    (tmp_path / "marked.toml").write_text('sequence = ["a", "b"]', encoding="utf-8-sig")  # by an editor
    assert read_task(tmp_path / "marked.toml").sequence == ("a", "b")
    (tmp_path / "bad.toml").write_text("moves = [")
    (tmp_path / "latin.toml").write_bytes(b'sequence = ["\xe9"]')
    for name, line in (("absent.toml", r"absent\.toml: no such file; expected a TOML file"),
                       ("bad.toml", r"bad\.toml: not valid TOML: "),
                       ("latin.toml", r"latin\.toml: cannot be read"), (".", "cannot be read")):  # fmt: skip
        refused(line, read, tmp_path / name)


PAPER = BlockTask({"block1": "block2", "block2": GROUND}, (Move("block1", GROUND), Move("block2", "block1")))
TOWER = BlockTask({"a": "b", "b": "c", "c": GROUND},
                  (Move("a", GROUND), Move("b", GROUND), Move("c", "b"), Move("a", "c")))  # fmt: skip
SLIDE = BlockTask({"a": GROUND}, (Move("a", GROUND, slide=True),))


def ways(found: decomposing.Decomposition, owner: str, name: str) -> list[tuple[int, ...]]:
    return [evidence.subtasks for evidence in found.properties[owner][name].evidence]


def test_physics_and_the_papers_table_1_name_what_each_subtask_tells():
    found = decompose(PAPER)
    signals = {i: {entry.name: evidence.signals(i) for entry, evidence in found.reveals(i)
                   if found.in_paper(i, entry)} for i in range(4)}  # fmt: skip
    forces = ("horizontal forces", "vertical forces")
    on_ground = {"height": ("vertical positions",), "friction": forces}
    above = {"weight": ("vertical forces",), "width": ("horizontal positions",), "friction": forces}
    assert signals == {0: {}, 1: on_ground, 2: above, 3: on_ground}
    assert ways(found, "block2", "height") == [(1, 3)]
    assert ways(found, "block1", "width") == [(1,), (2,), (3,)] and ways(found, "block1", "weight") == [(2,)]
    assert ways(found, "block1", "friction") == [(1,), (2,), (3,)]
    assert {name: entry.kind for name, entry in found.properties["block1"].items()} == {
        "weight": "value", "width": "value", "height": "value", "friction": "bound",
        "friction_on_block2": "bound", "friction_on_ground": "bound"}  # fmt: skip


def test_tower_heights_take_several_moves_and_some_are_known_only_together():
    found = decompose(TOWER)
    rises = [{"b": -1, "c": -1}, {"c": -1}, {"b": 1}, {"b": 1, "c": 1}]
    assert height_equations(TOWER) == list(enumerate(rises)) and ways(found, "c", "height") == [(5, 7)]
    assert ways(found, "b", "height") == [(9, 11)]
    short = decompose(BlockTask(TOWER.initial, TOWER.moves[:2]))
    assert ways(short, "b", "height") == [(1, 3, 5, 7)]  # b + c from the first move, c from the second
    assert short.properties["a"]["height"].evidence == ()
    found = decompose(BlockTask(TOWER.initial, TOWER.moves[:1]))
    reasons = {name: entries["height"].reason for name, entries in found.properties.items()}
    assert reasons == {"a": "no recorded move changes the height at which something rests by a's height",
                       "b": "move 1 changes heights by b's only together with the height of c",
                       "c": "move 1 changes heights by c's only together with the height of b"}  # fmt: skip
    for name in ("weight", "width", "friction"):
        assert found.properties["b"][name].reason == "no recorded move grips b"


def test_a_slide_tells_friction_and_weight_together_or_friction_of_a_known_weight():
    found = decompose(SLIDE)
    assert [s.name for s in found.subtasks] == ["pregrasp", "pickup", "slide", "place", "release"]
    assert [s.state for s in found.subtasks][1:4] == ["hold-on-ground", "sliding-on-ground", "hold-on-ground"]
    assert found.subtasks[2].constraints == ("a-ground (slipping)", "finger1-a", "finger2-a")
    # Coulomb's law at several loads is a line: its slope and intercept tell friction and weight.
    for name in ("weight", "friction_on_ground"):
        (evidence,) = found.properties["a"][name].evidence
        found_in = evidence.subtasks, evidence.bound, evidence.condition
        assert found_in == ((2,), False, decomposing.VARYING_LOAD)
        assert evidence.signals() == ("horizontal forces", "vertical forces")
    assert found.properties["a"]["width"].kind == "value"
    found = decompose(BlockTask({"a": GROUND}, (Move("a", GROUND), Move("a", GROUND, slide=True))))
    slid = [e for e in found.properties["a"]["friction_on_ground"].evidence if not e.bound]
    assert [(e.subtasks, e.given, e.condition) for e in slid] == [((6,), (("weight", "a"),), None)]
    assert ways(found, "a", "weight") == [(2,)]


def test_repeats_of_moves_and_unknowns_that_are_known():
    moves = (Move("a", "b"), Move("a", GROUND))
    twice = decompose(BlockTask({"a": GROUND, "b": GROUND}, moves, repeat=2))
    assert [s.move for s in twice.subtasks] == [0] + [m for m in range(4) for _ in range(4)]
    assert ways(twice, "a", "weight") == [(2,), (6,), (10,), (14,)]
    assert ways(twice, "b", "height") == [(1, 3), (5, 7), (9, 11), (13, 15)]
    unknown = decompose(BlockTask({"a": GROUND, "b": GROUND}, moves, repeat="unknown"))
    assert len(unknown.subtasks) == 9
    assert unknown.notes == ("the moves repeat as often as the recording shows; one round is decomposed",)
    both = {("weight", "a"): Fraction(1), ("load",): Fraction(-1), Source(0, "f"): Fraction(-1)}
    assert determined([both]) == {} and set(determined([both], known=[("weight", "a")])) == {("load",)}


@st.composite
def block_tasks(draw):
    """Plain arguments of tasks, as the type checker draws random numbers, which hypothesis forbids."""
    names = ["a", "b", "c", "d"][: draw(st.integers(1, 4))]
    support: dict[str, str] = {}
    for name in names:
        free = [GROUND] + [other for other in support if other not in support.values()]
        support[name] = draw(st.sampled_from(free))
    initial, moves = dict(support), []
    for _ in range(draw(st.integers(1, 6))):
        free = [name for name in names if name not in support.values()]
        name, slide = draw(st.sampled_from(free)), draw(st.booleans())
        to = support[name] if slide else draw(st.sampled_from([GROUND, *(f for f in free if f != name)]))
        moves.append((name, to, slide))
        support[name] = to
    return initial, moves


@settings(max_examples=60, deadline=None)
@given(block_tasks())
def test_heights_agree_with_stacking_and_rank_and_every_property_has_evidence_or_a_reason(arguments):
    task = BlockTask(arguments[0], tuple(Move(*move) for move in arguments[1]))
    heights = dict(zip(task.objects, np.sqrt([2.0, 3.0, 5.0, 7.0]), strict=False))
    support = dict(task.initial)

    def bottom(name: str) -> float:
        return 0.0 if support[name] == GROUND else bottom(support[name]) + heights[support[name]]

    matrix = np.zeros((len(task.moves), len(task.objects)))
    for (index, rise), move in zip(height_equations(task), task.moves, strict=True):
        before = bottom(move.object)
        support[move.object] = move.to
        risen = sum(heights[name] * c for name, c in rise.items())
        assert risen == pytest.approx(bottom(move.object) - before)
        matrix[index, [task.objects.index(name) for name in rise]] = list(rise.values())
    free = np.abs(null_space(matrix)).max(axis=1, initial=0.0) > 1e-9
    found = decompose(task)
    assert [found.properties[name]["height"].kind == "value" for name in task.objects] == list(~free)
    lifted = {move.object for move in task.moves if not move.slide}
    touched = {move.object for move in task.moves}
    for name, entries in found.properties.items():
        for entry in entries.values():
            assert (entry.reason is None) == bool(entry.evidence)
        plain = [e for e in entries["weight"].evidence if e.condition is None]
        assert bool(plain) == (name in lifted)
        assert (entries["width"].kind, entries["friction"].kind) == (
            ("value", "bound") if name in touched else (None, None))  # fmt: skip


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(st.integers(-2, 2), min_size=5, max_size=5), min_size=1, max_size=6))
def test_elimination_agrees_with_numerical_null_space(rows):
    equations = [
        {("weight", str(j)): Fraction(c) for j, c in enumerate(row) if c} | {Source(i, "f"): Fraction(-1)}
        for i, row in enumerate(rows)
    ]
    found = determined(equations)
    free = np.abs(null_space(np.array(rows, dtype=float))).max(axis=1, initial=0.0) > 1e-9
    assert {int(name) for _, name in found} == set(np.flatnonzero(~free))
    for (_, name), row in found.items():  # its sources are the combination that leaves it alone
        combined = sum(float(c) * np.array(rows[source.subtask]) for source, c in row.items())
        np.testing.assert_allclose(combined, np.eye(5)[int(name)], atol=1e-12)
