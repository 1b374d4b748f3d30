"""What `import hmmseg, estimation, simgap` offers, used as a stranger would."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refused

import estimation
import hmmseg
import simgap
from hmmseg import InputError, Rig, Task, Trial, align, segment

STACK = Path(__file__).parents[1] / "recordings" / "none_1"
PUBLIC = {hmmseg: "InputError Rig Segmentation Task Trial Watcher __version__ align decompose diagnose "
          "example_folder fit identify segment simulate", estimation: "Identification identify read_actual",
          simgap: "Block Diagnosis SimulatedTrial VirtualModel diagnose effects simulate"}  # fmt: skip
CELLS = ("import hmmseg\nfolder = hmmseg.example_folder()\n"
         "found = hmmseg.segment(folder / 'trial_01.csv', folder / 'task.toml', folder / 'rig.toml')\nfound",
         "found[0]", "print(f'{found[0]}')", "found[0].plot()")  # fmt: skip


@pytest.mark.parametrize("package", PUBLIC, ids=lambda p: p.__name__)
def test_what_is_public_is_listed_and_there(package):
    assert sorted(package.__all__) == PUBLIC[package].split()
    for name in package.__all__:
        assert getattr(package, name) is not None and name in dir(package)
    assert {name for name in dir(package) if not name.startswith("__")} <= set(package.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = package.nothing


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


def test_importing_loads_nothing_heavy_and_leaves_jax_alone():
    heavy = run("import sys, hmmseg, estimation, simgap; print([m for m in ('jax', 'pandas', 'scipy', "
                "'matplotlib', 'arviz') if m in sys.modules])")  # fmt: skip
    assert heavy.strip() == "[]"
    code = "import jax; before = dict(jax.config.values); from hmmseg import align; from estimation import " \
           "identify; from simgap import diagnose; print(before == jax.config.values)"  # fmt: skip
    assert run(code).strip() == "True"


@pytest.fixture(scope="module")
def found():
    aligned = align([STACK / "trial_01.csv", STACK / "trial_02.csv"], STACK / "task.toml", STACK / "rig.toml")
    return estimation.identify(aligned)


SINGLE = """
import os
os.environ.pop("JAX_ENABLE_X64", None)
import jax
from estimation import identify
from hmmseg import Task, align
from simgap import VirtualModel, simulate
assert not jax.config.jax_enable_x64
aligned = align({trials!r}, {task!r}, {rig!r})
found = identify(aligned)
made = simulate({task!r}, {rig!r}, found, seed=3)[0]
model = VirtualModel(aligned.rig, aligned.task, made.blocks, {{"block1": 0.13, "block2": 0.13}})
force = model.step([[0.10, 0.02], [0.15, 0.02]], [[0.0, 0.0], [0.0, 0.0]], 0.001)
assert not jax.config.jax_enable_x64 and jax.numpy.ones(1).dtype == "float32"
print(aligned.segmentations[0].log_evidence, found.of("block1", "weight").mean(),
      made.trial.channels["fx1"].sum(), force[0, 0])
"""


def test_a_process_whose_jax_is_single_precision_gets_the_same_answers(found):
    task, rig, *trials = (str(STACK / n) for n in ("task.toml", "rig.toml", "trial_01.csv", "trial_02.csv"))
    single = [float(word) for word in run(SINGLE.format(trials=trials, task=task, rig=rig)).split()]
    aligned = found.aligned
    made = simgap.simulate(task, rig, found, seed=3)[0]
    model = simgap.VirtualModel(aligned.rig, aligned.task, made.blocks, {"block1": 0.13, "block2": 0.13})
    force = model.step([[0.10, 0.02], [0.15, 0.02]], [[0.0, 0.0], [0.0, 0.0]], 0.001)
    double = [aligned.segmentations[0].log_evidence, found.of("block1", "weight").mean(),
              made.trial.channels["fx1"].sum(), force[0, 0]]  # fmt: skip
    assert single == pytest.approx(double, rel=1e-9)


def test_readers_take_paths_tables_and_arrays():
    rig, task = Rig.read(STACK / "rig.toml"), Task.read(STACK / "task.toml")
    assert Rig.read(rig) is rig and Task.read(task) is task
    frame = pd.read_csv(STACK / "trial_01.csv")
    arrays = {name: frame[name].to_numpy() for name in frame.columns}
    trials = [Trial.read(source, rig) for source in (STACK / "trial_01.csv", frame, arrays)]
    for trial in trials[1:]:
        np.testing.assert_array_equal(trial.channels["fx1"], trials[0].channels["fx1"])
    assert Trial.read(trials[0], rig) is trials[0]
    row = next(line for line in repr(trials[0]).splitlines() if " fx1 " in line).split("│")
    assert float(row[3]) == pytest.approx(frame["fx1"].min(), rel=1e-3)
    assert f"{len(frame)} samples at 20 Hz" in repr(trials[0])
    spans = [segment(source, task, rig)[0].spans for source in (frame, arrays)]
    assert spans[0] == spans[1]


def test_mistakes_say_what_to_write():
    refused("rig: missing", segment, STACK / "trial_01.csv", STACK / "task.toml")
    refused("no blocks", align, STACK / "trial_01.csv", {"sequence": ["a", "b"]}, STACK / "rig.toml")
    bare = hmmseg.Trial("bare", np.arange(9.0), {"x1": np.zeros(9)})
    refused("bare: has no channel fx1", segment, bare, STACK / "task.toml", STACK / "rig.toml")
    with pytest.raises(InputError, match=r"block1\.width: missing; expected a number in m"):
        simgap.simulate(STACK / "task.toml", STACK / "rig.toml", {"block1": {"weight": 0.3}, "block2": {}})
    refused("needs no fit", hmmseg.fit, STACK / "trial_01.csv", STACK / "task.toml")
    for none in (lambda: segment([], STACK / "task.toml", STACK / "rig.toml"),
                 lambda: segment([], {"sequence": ["a", "b"]})):  # fmt: skip
        refused("trials: none given; expected at least one trial", none)


def test_a_notebook_shows_every_result_once_and_every_plot():
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    from nbclient import NotebookClient

    cells = [nbformat.v4.new_code_cell(source) for source in CELLS]
    NotebookClient(nbformat.v4.new_notebook(cells=cells), timeout=300).execute()
    shown = [[o for o in cell.outputs if o.get("name") != "stderr"] for cell in cells]
    several, one, printed, plot = shown
    assert len(several) == len(one) == len(printed) == 1
    assert "pickup block1" in several[0].data["text/plain"] and "<table>" in one[0].data["text/html"]
    assert "pickup block1" in printed[0].text and any("image/png" in output.data for output in plot)


def test_results_read_like_the_terminals_table_and_fill_no_screen(found, monkeypatch):
    seen = {}
    inside(found, seen)
    assert len(seen) > 50
    assert max(len(repr(value)) for value in seen.values()) < 2500  # characters
    text = repr(found)
    assert "block1" in text and "weight" in text and "95 % interval" in text
    assert "<table>" in found._repr_html_() and "<td>block1</td>" in found._repr_html_()
    segmentation = found.segmentations[0]
    assert "pickup block1" in repr(segmentation) and "hold-on-ground" in segmentation._repr_html_()
    aligned = found.aligned
    assert "trial_02.csv" in repr(aligned) and len(aligned.to_json()["trials"]) == 2
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)  # though rich would show them itself
    assert "block1" in f"{found}" and "pickup block1" in repr(found.segmentations)


def inside(value, seen):
    if id(value) in seen:
        return
    if dataclasses.is_dataclass(value):
        seen[id(value)] = value
        for field in dataclasses.fields(value):
            inside(getattr(value, field.name), seen)
    elif isinstance(value, list | tuple | dict):
        for each in value.values() if isinstance(value, dict) else value:
            inside(each, seen)


def test_learned_models_and_simulated_trials_show_what_they_hold(found, tmp_path):
    made = simgap.simulate(STACK / "task.toml", STACK / "rig.toml", seed=3)[0]
    text = repr(made)
    assert "pickup block1" in text and "0.343 N" in text and "1.59 cm" in text
    starts = [span.start for span in made.segmentation.spans[1:]]
    np.testing.assert_array_equal(starts, made.boundaries)
    assert made.to_json()["seed"] == made.seed
    made.plot(tmp_path / "truth.png")
    assert (tmp_path / "truth.png").stat().st_size > 10_000
    t = np.arange(0.0, 6.0, 0.02)
    noise = np.random.default_rng(0).normal(0.0, 0.05, (4, t.size))
    trials = [{"t": t, "force": np.where(t < 2.0 + 0.3 * k, 0.0, 3.0) + noise[k]} for k in range(4)]
    model = hmmseg.fit(trials, {"sequence": ["approach", "press"]})
    row = next(line for line in repr(model).splitlines() if "approach" in line)
    assert float(row.split("│")[2]) == pytest.approx(2.45, abs=0.05)
    assert "<td>press</td>" in model._repr_html_()


def test_plots_return_axes_and_wrong_names_name_the_nearest(found, tmp_path):
    with pytest.raises(KeyError, match=r"blok1.*block1"):
        found.of("blok1", "weight")
    with pytest.raises(KeyError, match=r"wieght.*weight"):
        found.of("block1", "wieght")
    with pytest.raises(KeyError, match=r"did you mean weight"):
        found.of("block1", "mass")
    assert len(found.segmentations[0].plot()) == 7 and found.plot_estimates() is not None
    assert len(found.plot_check()) == 2
    found.plot_posterior(str(tmp_path / "corner.png"))
    assert (tmp_path / "corner.png").stat().st_size > 10_000
    assert set(found.to_arviz().posterior) == {f"{o}.{p}" for o, p in found.names}


def test_blocks_may_be_tables_or_an_identification_or_its_json(found, tmp_path):
    one = {"weight": 0.3, "width": 0.02, "height": 0.02}
    made = simgap.simulate(STACK / "task.toml", STACK / "rig.toml", {"block1": one, "block2": one})
    assert {made[0].blocks["block1"].weight, made[0].blocks["block2"].weight} == {0.3}
    task = Task.read(STACK / "task.toml")
    high = {name: dataclasses.replace(f, lower_bound=1.5, mu_draws=None)
            for name, f in found.friction.items()}  # fmt: skip
    rough = dataclasses.replace(found, friction=high)
    (tmp_path / "found.json").write_text(json.dumps(rough.to_json()))
    blocks = simgap.simulate(task, STACK / "rig.toml", rough, seed=3)[0].blocks
    assert blocks["block1"].weight == pytest.approx(found.of("block1", "weight").mean())
    assert blocks == simgap.simulate(task, STACK / "rig.toml", tmp_path / "found.json", seed=3)[0].blocks
    assert {name: block.friction for name, block in blocks.items()} == dict.fromkeys(high, 1.5)
