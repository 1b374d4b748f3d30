"""Reading trials of every kind, every trial refused with its message, and task-space signals."""

import numpy as np
import pandas as pd
import pytest

from hmmseg.errors import InputError
from hmmseg.hand.read import read_trial
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import parse_rig
from hmmseg.io.task import SequenceTask
from hmmseg.io.trial import CARTESIAN_CHANNELS, JOINT_CHANNELS

FINGERS = {
    "1": {"base": [0.05, 0.17], "links": [0.12, 0.11]},
    "2": {"base": [0.21, 0.17], "links": [0.1, 0.12]},
}
JOINTED = parse_rig({"fingers": FINGERS, "noise": {"angle": 2e-4, "velocity": 0.03, "force": 0.012}})
CARTESIAN = parse_rig({"noise": {"position": 1e-4, "velocity": 0.01, "force": 0.02}})
PLAIN = SequenceTask(("a", "b"))


def table(channels=JOINT_CHANNELS, samples=12) -> pd.DataFrame:
    values = np.random.default_rng(0).normal(scale=0.1, size=(samples, len(channels))).round(6)
    frame = pd.DataFrame(values, columns=list(channels))
    frame.insert(0, "t", np.arange(samples) * 0.05)
    return frame


def assert_same(trial, frame):
    np.testing.assert_allclose(trial.t, frame["t"], rtol=1e-12)
    for name, values in trial.channels.items():
        np.testing.assert_allclose(values, frame[name].to_numpy(dtype=float), rtol=1e-12)


def test_every_kind_of_file_holds_the_same_trial(tmp_path):
    frame = table()
    shuffled = frame[list(frame.columns[::-1])].assign(note="ignored")
    shuffled.to_csv(tmp_path / "a.csv", index=False)
    shuffled.to_parquet(tmp_path / "a.parquet", index=False)
    np.savez(tmp_path / "a.npz", **{name: frame[name].to_numpy() for name in frame})
    for name in ("a.csv", "a.parquet", "a.npz"):
        trial = read_trial(tmp_path / name, JOINTED)
        assert set(trial.channels) == set(JOINT_CHANNELS)
        assert trial.name == name
        assert_same(trial, frame)
    assert_same(read_trial(frame.set_index(np.arange(100, 112)), JOINTED), frame)


def test_csv_as_spreadsheets_write_it(tmp_path):
    frame = table()
    lines = frame.to_csv(index=True).splitlines()  # with a nameless column of row numbers
    text = "\r\n".join([lines[0].replace(",", " , "), *lines[1:5], "", *lines[5:]]) + "\r\n\r\n"
    (tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert_same(read_trial(tmp_path / "a.csv", JOINTED), frame)
    assert "t" not in read_trial(tmp_path / "a.csv", task=PLAIN).channels
    assert set(read_trial(tmp_path / "a.csv", task=PLAIN).channels) == set(JOINT_CHANNELS)


def test_missing_cells_and_uneven_times(tmp_path):
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
    assert np.isnan(signals.fx[3])
    assert np.isnan(signals.x[5])
    assert np.isfinite(signals.fy[[3, 5]]).all()


@pytest.mark.parametrize("rate", [10.0, 20.0, 1000.0, 5000.0])
def test_rate(rate):
    frame = table()
    frame["t"] = np.arange(12) / rate
    frame.loc[11, "t"] += 3.0  # a pause is not the rate
    assert read_trial(frame, JOINTED).rate == pytest.approx(rate)


def test_integers_and_nullable_columns():
    frame = table()
    frame["fx1"] = pd.array([1, None] * 6, dtype="Int64")
    frame["fy1"] = 2
    trial = read_trial(frame, JOINTED)
    np.testing.assert_array_equal(trial.channels["fx1"], [1, np.nan] * 6)
    np.testing.assert_array_equal(trial.channels["fy1"], 2.0)


def test_channels_of_a_plain_task():
    frame = table(("fx", "fy", "note"))
    assert set(read_trial(frame, task=PLAIN).channels) == {"fx", "fy", "note"}
    assert set(read_trial(frame, task=SequenceTask(("a",), channels=("fy",))).channels) == {"fy"}


def csv(change):
    lines = table().to_csv(index=False).splitlines()
    return "\n".join(change(lines))


def cell(row, column, text):
    """The CSV with one cell changed; rows as an editor numbers them."""

    def change(lines):
        cells = lines[row - 1].split(",")
        cells[("t", *JOINT_CHANNELS).index(column)] = text
        return [*lines[:row - 1], ",".join(cells), *lines[row:]]  # fmt: skip

    return csv(change)  # fmt: skip


REFUSED_CSV = [
    ("", "column t: missing; expected a header row with a column t of times in s"),
    (csv(lambda lines: lines[1:]), "column t: missing; expected a header row"),
    (csv(lambda lines: [lines[0].replace("fx1", "fz1"), *lines[1:]]), "column fx1: missing; expected t, q"),
    (csv(lambda lines: [lines[0].replace("fx1", "q11"), *lines[1:]]), "column q11: appears twice"),
    (csv(lambda lines: lines[:8]), "has 7 samples; expected at least 8"),
    (csv(lambda lines: lines[:1]), "has 0 samples; expected at least 8"),
    (csv(lambda lines: [*lines[:4], lines[4] + ",1,2", *lines[5:]]),
     "row 5: has 15 cells; expected 13 as in the header"),
    (csv(lambda lines: [lines[0], *(line + ",1" for line in lines[1:])]),
     "row 2: has 14 cells; expected 13"),
    (csv(lambda lines: [*lines[:6], "0.55,0.3", *lines[6:]]),
     "row 7: has 2 cells; expected 13 as in the header"),
    (cell(5, "fy2", "x"), "row 5, column fy2: x is not a finite number; expected a number or an empty cell"),
    (cell(5, "fy2", "inf"), "row 5, column fy2: inf is not a finite number"),
    (cell(5, "fy2", "0.1.2"), "row 5, column fy2: 0.1.2 is not a finite number"),
    (cell(2, "t", "soon"), "row 2, column t: soon is not a finite number"),
    (cell(4, "t", ""), "row 4, column t: missing; expected a time in s"),
    (cell(4, "t", "0.05"), "row 4, column t: 0.05 after 0.05; expected strictly increasing times"),
    (cell(4, "t", "-1"), "row 4, column t: -1 after 0.05; expected strictly increasing"),
    ("\n" + csv(lambda lines: lines[1:]), "column t: missing; expected a header row"),
    (csv(lambda lines: [*lines[:4], "", "", cell(5, "q11", "?").splitlines()[4], *lines[5:]]),
     r"row 7, column q11: \? is not a finite number"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), REFUSED_CSV)
def test_csv_refused_with_its_message(tmp_path, text, message):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"a\.csv: {message}") as caught:
        read_trial(path, JOINTED)
    assert "\n" not in str(caught.value)


REFUSED_TABLES = [
    (table().assign(fx1=np.nan), "DataFrame: column fx1: has no values; expected at least one number"),
    (table().assign(fx1=["a"] * 12), "DataFrame: row 1, column fx1: a is not a finite number"),
    (table().assign(fx1=pd.Timestamp("2020-01-01")),
     r"DataFrame: column fx1: holds datetime64.*; expected numbers"),
    (table().assign(fx1=True), "DataFrame: column fx1: holds bool; expected numbers"),
    (table().assign(fx1=1j), "DataFrame: column fx1: holds complex128; expected numbers"),
    (table().rename(columns={"fx1": "q11"}), "DataFrame: column q11: appears twice; expected one of each"),
    (table().drop(columns="t"), "DataFrame: column t: missing"),
    (pd.DataFrame(), "DataFrame: column t: missing"),
]  # fmt: skip


@pytest.mark.parametrize(("frame", "message"), REFUSED_TABLES)
def test_dataframe_refused_with_its_message(frame, message):
    with pytest.raises(InputError, match=f"^{message}"):
        read_trial(frame, JOINTED)


def test_plain_task_refusals():
    with pytest.raises(InputError, match="DataFrame: has no columns but t; expected at least one channel"):
        read_trial(table(()), task=PLAIN)
    with pytest.raises(InputError, match="DataFrame: column fz: missing; expected one of fx, fy, t"):
        read_trial(table(("fx", "fy")), task=SequenceTask(("a",), channels=("fz",)))
    with pytest.raises(ValueError, match="a block task's trial needs its rig"):
        read_trial(table())


def test_cartesian_hand_needs_its_columns():
    with pytest.raises(InputError, match="column x1: missing; expected t, x1, y1, vx1"):
        read_trial(table(JOINT_CHANNELS), CARTESIAN)


def test_readings_that_no_sensor_gives_are_refused():
    frame = table(CARTESIAN_CHANNELS)
    frame.loc[3, "fy2"] = -1e300
    with pytest.raises(InputError, match=r"row 4, column fy2: -1e\+300 is no reading of a hand's sensor"):
        read_trial(frame, CARTESIAN)


def test_times_beyond_all_clocks_are_refused():
    frame = table(CARTESIAN_CHANNELS)
    frame["t"] = frame["t"].astype(float)
    frame.loc[len(frame) - 1, "t"] = 1e200
    with pytest.raises(InputError, match=r"column t: 1e\+200 is no time; expected a time in s"):
        read_trial(frame, CARTESIAN)


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
        with pytest.raises(InputError, match=message) as caught:
            read_trial(tmp_path / name, JOINTED)
        assert "\n" not in str(caught.value)
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(InputError, match=r"folder\.csv: is a folder; expected a trial"):
        read_trial(tmp_path / "folder.csv", JOINTED)
    with pytest.raises(InputError, match=r"absent\.csv: no such file; expected a trial"):
        read_trial(tmp_path / "absent.csv", JOINTED)
    np.savez(tmp_path / "uneven.npz", t=np.arange(9), q11=np.arange(8))
    with pytest.raises(InputError, match=r"uneven\.npz: column .*: has . rows; expected . as in the"):
        read_trial(tmp_path / "uneven.npz", JOINTED)
    with (tmp_path / "one.npz").open("wb") as file:
        np.save(file, np.arange(9))
    with pytest.raises(
        InputError, match=r"one\.npz: holds one array without a name; expected one array a column"
    ):
        read_trial(tmp_path / "one.npz", JOINTED)
