"""`hmmseg diagnose --against`: document, figures, page and refusals."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from experiments.generic_ensembles import ensemble
from hmmseg.errors import InputError
from hmmseg.example import example_folder
from hmmseg_cli.main import main


@pytest.fixture
def folder(tmp_path):
    """A plain ordered task with real trials that carry a large bias, and simulated ones."""
    rng = np.random.default_rng(7)
    for name, effects in (("real", {"force_bias": {"value": 1.0}}), ("sim", None)):
        trials, _ = ensemble(rng, 5, effects, name=name)
        for trial in trials:
            pd.DataFrame({"t": trial.t, **trial.channels}).to_csv(tmp_path / trial.file, index=False)
    (tmp_path / "task.toml").write_text('sequence = ["approach", "press", "hold"]\n')
    return tmp_path


def arguments(folder, *more, count=5):
    trials = {kind: [str(folder / f"{kind}_{k:02d}.csv") for k in range(count)] for kind in ("real", "sim")}
    task = ["--task", str(folder / "task.toml")]
    return ["diagnose", *trials["real"], *task, "--against", *trials["sim"], *more]


def test_values_of_against_reach_up_to_the_next_option(folder, monkeypatch):
    taken = {}

    def against(out, paths, sims, *rest):
        taken["real"], taken["sim"] = [p.name for p in paths], [p.name for p in sims]

    monkeypatch.setattr("hmmseg_cli.diagnose._against", against)
    given = arguments(folder, "--seed", "1")
    assert main(given) == 0
    once = taken | {}
    again = [a for n in given[given.index("--against") + 1 : -2] for a in ("--against", n)]
    assert main([*given[: given.index("--against")], *again]) == 0
    assert once == taken and len(once["sim"]) == len(once["real"]) == 5


def test_columns_of_a_plain_task_are_those_that_the_rig_maps(folder, tmp_path):
    for path in [*folder.glob("real_*.csv"), *folder.glob("sim_*.csv")]:
        pd.read_csv(path).rename(columns={"t": "stamp"}).to_csv(path, index=False)
    (folder / "columns.toml").write_text('[columns]\nt = {from = "stamp"}\n')
    out = tmp_path / "out.json"
    args = arguments(folder, "--rig", str(folder / "columns.toml"), "--json", str(out), "--quiet")
    assert main(args) == 0 and json.loads(out.read_text())["causes"] == ["force_bias"]


def test_a_gap_between_boundaries_that_could_be_elsewhere_comes_with_a_warning(folder, tmp_path):
    (folder / "task.toml").write_text('sequence = ["approach", "press"]\n')  # one of two changes
    out = tmp_path / "out.json"
    assert main(arguments(folder, "--json", str(out), "--quiet")) == 0
    assert any("as well be elsewhere" in line for line in json.loads(out.read_text())["warnings"])


def test_a_plain_task_without_simulated_trials_is_refused(folder, capsys):
    args = arguments(folder)
    assert main(args[: args.index("--against")]) == 2
    line = capsys.readouterr().err
    assert "--against SIM" in line and line.count("\n") == 1


@pytest.mark.parametrize(("more", "line"), [
    (["--actual", "actual.toml"], "does not go with --against"),
    (["--healthy", "sim_04.csv"], "does not go with --against"),
    (["--effect", "grip_slip"], "needs the virtual model"),
    (["--against", "real_00.csv"], "the same trial as"),
])  # fmt: skip
def test_what_does_not_go_with_given_trials_is_refused(folder, capsys, monkeypatch, more, line):
    monkeypatch.chdir(folder)
    (folder / "actual.toml").write_text("")
    assert main(arguments(folder, *more)) == 2 and line in capsys.readouterr().err


def test_trials_as_simulate_writes_them_go_with_recordings_of_other_columns(tmp_path, monkeypatch):
    example, read = example_folder(), []
    clock = '\n[columns]\nt = {from = "stamp", unit = "ms"}\n'
    (tmp_path / "rig.toml").write_text((example / "rig.toml").read_text() + clock)
    table = pd.read_csv(example / "trial_01.csv").rename(columns={"t": "stamp"})
    table.assign(stamp=1000 * table.stamp).to_csv(tmp_path / "real.csv", index=False)

    def stop(real, simulated, *_):
        read.extend([*real, *simulated])
        raise InputError("test", "has seen enough")

    monkeypatch.setattr("simgap.generic.trials.align_block_trials", stop)
    args = ["--task", str(example / "task.toml"), "--rig", str(tmp_path / "rig.toml"), "--against"]
    assert main(["diagnose", str(tmp_path / "real.csv"), *args, str(example / "trial_01.csv")]) == 2
    real, simulated = read
    np.testing.assert_allclose(real.t, simulated.t, atol=1e-9)


@pytest.mark.slow
def test_a_bias_is_named_with_figures_and_page(folder):
    outputs = ["--json", f"{folder}/d.json", "--figures", f"{folder}/f", "--report", f"{folder}/p.html"]
    assert main(arguments(folder, *outputs, "--quiet")) == 0
    document = json.loads((folder / "d.json").read_text())
    assert document["format"] == "hmmseg.diagnose/1"
    assert (document["verdict"], document["causes"]) == ("named", ["force_bias"])
    assert document["effects"]["force_bias"]["parameters"]["fa"]["mean"] == pytest.approx(1.0, abs=0.1)
    assert document["effects"]["force_bias"]["parameters"]["fa"]["unit"] == "unit of fa"
    assert {row["channel"] for row in document["where"]} == {"fa"} and document["shrinkage"]["fraction"] > 0.9
    assert all((folder / "f" / f"gap_{n}.png").stat().st_size > 5000
               for n in ("where", "signal", "before_after"))  # fmt: skip
    page = (folder / "p.html").read_text()
    assert 'id="verdict"' in page and "force_bias" in page and not re.search(r"(src|href)=\"(?!data:)", page)
