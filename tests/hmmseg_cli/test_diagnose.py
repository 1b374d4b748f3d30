"""`hmmseg diagnose` and `hmmseg effects`: documents, refusals, figures and the page."""

from __future__ import annotations

import io
import json
import re
from dataclasses import replace

import pytest
from rich.console import Console

from hmmseg_cli.diagnose import tables
from hmmseg_cli.main import main


def test_effects_are_listed_with_priors(tmp_path, capsys):
    assert main(["effects", "--json", str(tmp_path / "e.json")]) == 0
    document = json.loads((tmp_path / "e.json").read_text())
    assert document["format"] == "hmmseg.effects/1"
    bias = next(e for e in document["effects"] if e["name"] == "force_bias")
    assert [p["name"] for p in bias["parameters"]] == ["fx1", "fy1", "fx2", "fy2"]
    assert bias["parameters"][0]["unit"] == "N"
    assert "force_bias" in capsys.readouterr().out


def test_an_unknown_effect_is_refused(shared, capsys):
    folder = shared / "recordings/none_1"
    args = [
        "diagnose",
        str(folder / "trial_01.csv"),
        "--task",
        str(folder / "task.toml"),
        "--rig",
        str(folder / "rig.toml"),
        "--effect",
        "force_bais",
    ]
    assert main(args) == 2
    assert "force_bias" in capsys.readouterr().err


def test_a_plain_task_is_refused(tmp_path, shared, capsys):
    (tmp_path / "task.toml").write_text('sequence = ["approach", "mating"]\n')
    folder = shared / "recordings/none_1"
    args = [
        "diagnose",
        str(folder / "trial_01.csv"),
        "--task",
        str(tmp_path / "task.toml"),
        "--rig",
        str(folder / "rig.toml"),
    ]
    assert main(args) == 2
    assert "virtual model" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("rig", "more", "said"),
    [
        ("force = 0.012", [], "key noise.force: missing"),
        ("", ["--against"], "does not go with --against"),
    ],
)
def test_calibration_is_refused_where_nothing_can_be_simulated(shared, tmp_path, capsys, rig, more, said):
    folder = shared / "recordings/none_1"
    (tmp_path / "rig.toml").write_text((folder / "rig.toml").read_text().replace(rig, ""))
    args = ["diagnose", str(folder / "trial_01.csv"), "--task", str(folder / "task.toml"), "--rig",
            str(tmp_path / "rig.toml"), "--calibrate"]  # fmt: skip
    assert main([*args, *more, *([str(folder / "trial_02.csv")] if more else [])]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_a_calibrated_bank_is_taken_from_the_cache(shared, tmp_path, monkeypatch, capsys):
    from simgap.gap import own_bank
    from simgap.gap.bank import load_bank

    asked, bank = [], replace(load_bank(), reference=None)
    monkeypatch.setattr(own_bank, "learned", lambda *args: asked.append(args) or bank)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = shared / "recordings/none_1"
    args = ["diagnose", *(str(folder / f"trial_{k:02d}.csv") for k in (1, 2)), "--task",
            str(folder / "task.toml"), "--rig", str(folder / "rig.toml"), "--calibrate", "--json",
            str(tmp_path / "d.json")]  # fmt: skip
    for _ in range(2):
        assert main(args) == 0
        assert json.loads((tmp_path / "d.json").read_text())["detection"]["bank"] == "calibrated"
        assert "Judged by healthy simulations of this rig and task." in capsys.readouterr().out
    assert len(asked) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "verdict", "cause"),
    [
        ("none_1", "none", []),
        ("cable_force_1", "named", ["cable_force"]),
        ("force_lag_1", "named", ["force_lag"]),
    ],
)
def test_recordings_are_diagnosed(shared, tmp_path, case, verdict, cause):
    folder = shared / "recordings" / case
    trials = sorted(str(p) for p in folder.glob("trial_*.csv"))[:3]
    args = [
        "diagnose",
        *trials,
        "--task",
        str(folder / "task.toml"),
        "--rig",
        str(folder / "rig.toml"),
        "--json",
        str(tmp_path / "d.json"),
        "--figures",
        str(tmp_path / "figures"),
        "--report",
        str(tmp_path / "page.html"),
        "--quiet",
    ]
    assert main(args) == 0
    document = json.loads((tmp_path / "d.json").read_text())
    assert document["verdict"] == verdict
    assert document["causes"] == cause
    assert sum(document["probabilities"].values()) == pytest.approx(1.0)
    assert all(
        (tmp_path / "figures" / name).stat().st_size > 5000 for name in ("gap_where.png", "gap_signal.png")
    )
    page = (tmp_path / "page.html").read_text()
    assert 'id="verdict"' in page
    assert not re.search(r"(src|href)=\"(?!data:)", page)  # nothing is fetched from anywhere
    if cause:
        assert document["shrinkage"]["fraction"] > 0.9
        assert document["where"]


def test_the_next_experiment_says_what_it_promises():
    asked = {
        "do": "work twice as fast",
        "separates": ["force_lag", "force_lowpass"],
        "expected_gain_nats": 41.3,
    }
    body = {"probabilities": {"force_lag": 1.0}, "causes": [], "where": [], "next_experiment": asked}
    sink = io.StringIO()
    console = Console(width=120, file=sink)
    for table in tables(body):
        console.print(table)
    said = sink.getvalue()
    assert "work twice as fast" in said
    assert "expected to tell force_lag, force_lowpass apart, by 41 nats at least" in said
    assert len(tables(body | {"next_experiment": None})) == len(tables(body)) - 1
