"""`hmmseg diagnose` and `hmmseg effects`: documents, refusals, figures and the page."""

import io
import json

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


def test_healthy_recordings_do_not_go_with_simulated_ones(shared, capsys):
    folder = shared / "recordings/none_1"
    one, two, three = (str(folder / f"trial_{k:02d}.csv") for k in (1, 2, 3))
    args = ["diagnose", one, "--task", str(folder / "task.toml"), "--rig", str(folder / "rig.toml"),
            "--against", two, "--healthy", three]  # fmt: skip
    assert main(args) == 2
    assert "does not go with --against" in capsys.readouterr().err


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
