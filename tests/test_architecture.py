"""Pages tell the truth of files, examples run, imports run downwards; what is public serves a stranger."""

import ast
import dataclasses
import doctest
import importlib
import importlib.util
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refused

import estimation
import hmmseg
import simgap
from hmmseg import Rig, Task, Trial, align, example_folder, segment
from hmmseg_cli.main import main

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TREES = ("hmmseg", "estimation", "simgap", "hmmseg_cli", "experiments", "paper_figs", "tests")
PATH = re.compile(rf"(?<![\w/.])((?:{'|'.join(TREES)})/[\w/]+\.(?:py|json|toml|j2|html))\b")
FLOORS = ("experiments", "paper_figs", "hmmseg_cli", "simgap", "estimation", "hmmseg")
ROOMS = ("online", "sequence", "segmentation", "hand", "contact", "io")  # of hmmseg, from the top down
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PRODUCT = tuple(PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])
LOCAL = {*PRODUCT, "experiments", "paper_figs", "tests"}
# Import names that differ from the name that is installed.
DISTRIBUTIONS = {"PIL": "pillow", "mcap_ros2": "mcap-ros2-support", "sklearn": "scikit-learn"}
TOOLS = {"ipykernel", "build", "furo", "myst-parser", "mypy", "pandas-stubs", "pre-commit",
         "pytest-xdist", "ruff", "scipy-stubs", "sphinx"}  # fmt: skip


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def test_every_type_stands_where_the_page_says():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    table = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|(?: [^|]+ \|)?? `([\w/]+\.py)` \|", text, re.MULTILINE)
    rows = [(name, file) for names, file in table for name in re.findall(r"[A-Z]\w+", names)]
    classes = {f: {n.name for n in tree_of(ROOT / f).body if isinstance(n, ast.ClassDef)} for _, f in rows}
    assert len(rows) >= 14 and [(name, file) for name, file in rows if name not in classes[file]] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_files_that_pages_name_are_there(page):
    named = set(PATH.findall(page.read_text(encoding="utf-8")))
    assert {file for file in named if "NAME" not in file and not (ROOT / file).exists()} == set()


@pytest.mark.parametrize("tree", TREES)
def test_no_module_is_longer_than_one_idea_takes(tree):
    lines = {path: path.read_text(encoding="utf-8").count("\n") for path in (ROOT / tree).rglob("*.py")}
    assert lines and {str(path): count for path, count in lines.items() if count > 700} == {}


def imported(path: Path) -> set[str]:
    """Top packages that a module imports anywhere; a relative import is its own package."""
    found = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
    return found


@pytest.mark.parametrize("package", FLOORS)
def test_imports_run_downwards(package):
    for path in sorted((ROOT / package).rglob("*.py")):
        above = imported(path) & set(FLOORS[: FLOORS.index(package)])
        assert not above, f"{path.relative_to(ROOT)} imports {', '.join(sorted(above))} from above"


@pytest.mark.parametrize("room", ROOMS)
def test_imports_within_hmmseg_run_downwards(room):
    """`Trial.read` alone looks up, to what judges a hand's recording: it is where users look for it."""
    above = {f"hmmseg.{name}" for name in ROOMS[: ROOMS.index(room)]}
    for path in sorted((ROOT / "hmmseg" / room).rglob("*.py")):
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ImportFrom) and node.module:
                seen = ".".join(node.module.split(".")[:2])
                allowed = path.name == "trial.py" and node.module == "hmmseg.hand.read"
                assert seen not in above or allowed, f"{path.relative_to(ROOT)} imports {node.module}"


@pytest.mark.parametrize("package", ["experiments", "paper_figs"])
def test_what_is_imported_is_there(package):
    pytest.importorskip("mujoco", reason="the blind check's simulator needs the extra `check`")
    for path in (path for path in sorted((ROOT / package).rglob("*.py")) if path.stem != "__main__"):
        ours = [n for n in ast.walk(tree_of(path)) if isinstance(n, ast.ImportFrom) and n.module
                and n.module.split(".")[0] in FLOORS]  # fmt: skip
        exec(compile(ast.Module(ours, []), str(path), "exec"), {})


def requirement(text: str) -> str:
    return re.split(r"[\[<>=!~; ]", text, maxsplit=1)[0].lower()


def declared(extra: str | None = None) -> set[str]:
    project = PROJECT["project"]
    entries = project["dependencies"] if extra is None else project["optional-dependencies"][extra]
    return {requirement(entry) for entry in entries} - {"hmmseg"}


def everywhere(*packages: str) -> set[str]:
    """Distributions that the modules of packages import anywhere."""
    paths = [path for package in packages for path in (ROOT / package).rglob("*.py")]
    found = set().union(*(imported(path) for path in paths))
    return {DISTRIBUTIONS.get(name, name) for name in found - sys.stdlib_module_names - LOCAL}


def extras() -> dict[str, set[str]]:
    return {name: declared(name) for name in PROJECT["project"]["optional-dependencies"]}


def test_the_product_and_every_extra_import_what_is_declared_and_all_of_it():
    used, optional = everywhere(*PRODUCT), set().union(*extras().values())
    assert used - optional - declared() == set(), "imported and not declared"
    assert declared() - used == set(), "declared and never imported"
    assert all((ROOT / package / "py.typed").exists() for package in PRODUCT)
    local = {path.stem for path in (ROOT / "tests").glob("*.py")}
    used = everywhere(*PRODUCT, "experiments", "paper_figs", "tests") - local
    for name, distributions in extras().items():
        assert distributions - used - TOOLS == set(), f"declared by the extra {name} and never imported"
    assert used - declared() - set().union(*extras().values()) == set(), "used and in no extra"


def test_the_solver_bug_of_mujoco_is_excluded_everywhere():
    entries = [e for extra in PROJECT["project"]["optional-dependencies"].values() for e in extra]
    entries += PROJECT["project"]["dependencies"]
    mujoco = [entry for entry in entries if requirement(entry) == "mujoco"]
    assert mujoco and all("!=4.0.0" in entry for entry in mujoco)


DOCUMENTED = ("hmmseg.api", "hmmseg.example", "estimation.api", "simgap.api")
SLOW = {"reading_a_diagnosis.md", "your_simulator.md"}
BLOCK = re.compile(r"(<!-- not run[^>]*-->\s*)?^```(python|console)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def blocks(text: str) -> list[tuple[str, str]]:
    return [(m[2], m[3]) for m in BLOCK.finditer(text) if not m[1]]


def pages() -> list:
    found = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    with_examples = [path for path in found if blocks(path.read_text(encoding="utf-8"))]
    return [pytest.param(path, id=path.name, marks=[pytest.mark.slow] if path.name in SLOW else [])
            for path in with_examples]  # fmt: skip


def expanded(words: list[str]) -> list[str]:
    """Words of a command line, those with a star replaced by the files they match."""
    out: list[str] = []
    for word in words:
        out += sorted(str(path) for path in Path().glob(word)) if "*" in word else [word]
    return out


@pytest.mark.parametrize("name", DOCUMENTED)
def test_docstrings(name):
    module = importlib.import_module(name)
    done = doctest.testmod(module, optionflags=doctest.ELLIPSIS)
    assert done.attempted > 0 and done.failed == 0


@pytest.mark.parametrize("page", pages())
def test_pages(page, tmp_path, monkeypatch, capsys):
    for path in example_folder().iterdir():
        shutil.copy(path, tmp_path)
    (tmp_path / "recordings").symlink_to(ROOT / "recordings")
    monkeypatch.chdir(tmp_path)
    namespace: dict = {"__name__": page.stem}
    for language, content in blocks(page.read_text(encoding="utf-8")):
        if language == "python":
            exec(compile(content, str(page), "exec"), namespace)
            continue
        for line in re.findall(r"^\$ (hmmseg .*)", content.replace("\\\n", " "), re.MULTILINE):
            code = main(expanded(shlex.split(line, comments=True))[1:])
            assert code == 0, f"{line}\n{capsys.readouterr().err}"


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


def printed(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


@pytest.fixture(scope="module")
def identified():
    aligned = align([STACK / "trial_01.csv", STACK / "trial_02.csv"], STACK / "task.toml", STACK / "rig.toml")
    return estimation.identify(aligned)


SINGLE = """
import jax
from hmmseg.jaxconfig import configure, keep_programs
configure()
keep_programs()  # else all are compiled anew
jax.config.update("jax_enable_x64", False)
from estimation import identify
from hmmseg import Task, align
from simgap import VirtualModel, simulate
assert not jax.config.jax_enable_x64
aligned = align({trials!r}, {task!r}, {rig!r})
identified = identify(aligned)
made = simulate({task!r}, {rig!r}, identified, seed=3)[0]
model = VirtualModel(aligned.rig, aligned.task, made.blocks, {{"block1": 0.13, "block2": 0.13}})
force = model.step([[0.10, 0.02], [0.15, 0.02]], [[0.0, 0.0], [0.0, 0.0]], 0.001)
assert not jax.config.jax_enable_x64 and jax.numpy.ones(1).dtype == "float32"
print(aligned.segmentations[0].log_evidence, identified.of("block1", "weight").mean(),
      made.trial.channels["fx1"].sum(), force[0, 0])
"""


def test_a_process_whose_jax_is_single_precision_gets_the_same_answers(identified):
    task, rig, *trials = (str(STACK / n) for n in ("task.toml", "rig.toml", "trial_01.csv", "trial_02.csv"))
    single = [float(word) for word in printed(SINGLE.format(trials=trials, task=task, rig=rig)).split()]
    aligned = identified.aligned
    made = simgap.simulate(task, rig, identified, seed=3)[0]
    model = simgap.VirtualModel(aligned.rig, aligned.task, made.blocks, {"block1": 0.13, "block2": 0.13})
    force = model.step([[0.10, 0.02], [0.15, 0.02]], [[0.0, 0.0], [0.0, 0.0]], 0.001)
    double = [aligned.segmentations[0].log_evidence, identified.of("block1", "weight").mean(),
              made.trial.channels["fx1"].sum(), force[0, 0]]  # fmt: skip
    assert single == pytest.approx(double, rel=1e-9)


def test_readers_take_paths_tables_and_what_was_read():
    rig, task = Rig.read(STACK / "rig.toml"), Task.read(STACK / "task.toml")
    assert Rig.read(rig) is rig and Task.read(task) is task
    trial, frame = Trial.read(STACK / "trial_01.csv", rig), pd.read_csv(STACK / "trial_01.csv")
    assert Trial.read(trial, rig) is trial and f"{len(frame)} samples at 20 Hz" in repr(trial)
    assert segment(frame, task, rig)[0].spans == segment(trial, task, rig)[0].spans


def test_mistakes_say_what_to_write():
    refused("rig: missing", segment, STACK / "trial_01.csv", STACK / "task.toml")
    refused("no blocks", align, STACK / "trial_01.csv", {"sequence": ["a", "b"]}, STACK / "rig.toml")
    bare = hmmseg.Trial("bare", np.arange(9.0), {"x1": np.zeros(9)})
    refused("bare: has no channel fx1", segment, bare, STACK / "task.toml", STACK / "rig.toml")
    few = {"block1": {"weight": 0.3}, "block2": {}}
    line = r"block1\.width: missing; expected a number in m"
    refused(line, simgap.simulate, STACK / "task.toml", STACK / "rig.toml", few)
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


def test_results_read_like_the_terminals_table_and_fill_no_screen(identified, monkeypatch):
    text, aligned = repr(identified), identified.aligned
    whole = (identified, aligned, aligned.trials[0])
    parts = [identified, *(value for each in whole for value in vars(each).values())]
    assert max(len(repr(value)) for value in parts if dataclasses.is_dataclass(value)) < 2500  # characters
    assert "block1" in text and "weight" in text and "95 % interval" in text
    assert "<table>" in identified._repr_html_() and "<td>block1</td>" in identified._repr_html_()
    segmentation = identified.segmentations[0]
    assert "pickup block1" in repr(segmentation) and "hold-on-ground" in segmentation._repr_html_()
    assert "trial_02.csv" in repr(aligned) and len(aligned.to_json()["trials"]) == 2
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)  # though rich would show them itself
    assert "block1" in f"{identified}" and "pickup block1" in repr(identified.segmentations)


def test_learned_models_and_simulated_trials_show_what_they_hold(identified, tmp_path):
    made = simgap.simulate(STACK / "task.toml", STACK / "rig.toml", seed=3)[0]
    text = repr(made)
    assert "pickup block1" in text and "0.343 N" in text and "1.59 cm" in text
    made.plot(tmp_path / "truth.png")
    assert (tmp_path / "truth.png").stat().st_size > 10_000
    t = np.arange(0.0, 6.0, 0.02)
    noise = np.random.default_rng(0).normal(0.0, 0.05, (4, t.size))
    trials = [{"t": t, "force": np.where(t < 2.0 + 0.3 * k, 0.0, 3.0) + noise[k]} for k in range(4)]
    model = hmmseg.fit(trials, {"sequence": ["approach", "press"]})
    row = next(line for line in repr(model).splitlines() if "approach" in line)
    assert float(row.split("│")[2]) == pytest.approx(2.45, abs=0.05)
    assert "<td>press</td>" in model._repr_html_()


def test_plots_return_axes_and_wrong_names_name_the_nearest(identified, tmp_path):
    for obj, prop, line in (("blok1", "weight", "blok1.*block1"), ("block1", "wieght", "wieght.*weight"),
                            ("block1", "mass", "did you mean weight")):  # fmt: skip
        refused(line, identified.of, obj, prop, error=KeyError)
    assert len(identified.segmentations[0].plot()) == 7 and identified.plot_estimates() is not None
    assert len(identified.plot_check()) == 2
    identified.plot_posterior(str(tmp_path / "corner.png"))
    assert (tmp_path / "corner.png").stat().st_size > 10_000
    assert set(identified.to_arviz().posterior) == {f"{o}.{p}" for o, p in identified.names}


def test_blocks_may_be_tables_or_an_identification_or_its_json(identified, tmp_path):
    one = {"weight": 0.3, "width": 0.02, "height": 0.02}
    made = simgap.simulate(STACK / "task.toml", STACK / "rig.toml", {"block1": one, "block2": one})
    assert {made[0].blocks["block1"].weight, made[0].blocks["block2"].weight} == {0.3}
    task = Task.read(STACK / "task.toml")
    high = {name: dataclasses.replace(f, lower_bound=1.5, mu_draws=None)
            for name, f in identified.friction.items()}  # fmt: skip
    rough = dataclasses.replace(identified, friction=high)
    (tmp_path / "found.json").write_text(json.dumps(rough.to_json()))
    blocks = simgap.simulate(task, STACK / "rig.toml", rough, seed=3)[0].blocks
    assert blocks["block1"].weight == pytest.approx(identified.of("block1", "weight").mean())
    assert blocks == simgap.simulate(task, STACK / "rig.toml", tmp_path / "found.json", seed=3)[0].blocks
    assert {name: block.friction for name, block in blocks.items()} == dict.fromkeys(high, 1.5)
    document = rough.to_json()
    document["properties"]["block2"]["height"] = None
    (tmp_path / "none.json").write_text(json.dumps(document))
    line = r"block2\.height: found None; expected a positive number in m"
    refused(line, simgap.simulate, task, STACK / "rig.toml", tmp_path / "none.json")
