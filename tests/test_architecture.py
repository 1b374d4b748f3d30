"""Pages tell the truth of files, imports run downwards, and pyproject.toml declares what is imported."""

import ast
import importlib
import importlib.util
import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TREES = ("hmmseg", "estimation", "simgap", "hmmseg_cli", "experiments", "paper_figs", "tests")
PATH = re.compile(rf"(?<![\w/.])((?:{'|'.join(TREES)})/[\w/]+\.(?:py|json|toml|j2|html))\b")
FLOORS = ("experiments", "paper_figs", "hmmseg_cli", "simgap", "estimation", "hmmseg")
ROOMS = ("online", "sequence", "segmentation", "hand", "contact", "io")  # of hmmseg, from the top down
OURS = ("hmmseg", "estimation", "simgap", "hmmseg_cli", "experiments", "paper_figs")
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


def imported_packages(nodes: Iterable[ast.AST]) -> set[str]:
    """Top packages that some statements of a module import; a relative import is its own package."""
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
    return found


def upward(package: str, source: str) -> set[str]:
    """Packages of higher floors that a module of `package` imports."""
    return imported_packages(ast.walk(ast.parse(source))) & set(FLOORS[: FLOORS.index(package)])


@pytest.mark.parametrize("package", FLOORS)
def test_imports_run_downwards(package):
    for path in sorted((ROOT / package).rglob("*.py")):
        above = upward(package, path.read_text(encoding="utf-8"))
        assert not above, f"{path.relative_to(ROOT)} imports {', '.join(sorted(above))} from above"


def test_upward_imports_and_what_is_imported_are_seen():
    assert upward("hmmseg", "def f():\n    from estimation.priors import x\n") == {"estimation"}
    assert upward("hmmseg", "import simgap.world.hand as h, hmmseg.io.task") == {"simgap"}
    assert upward("simgap", "from hmmseg import task\nimport estimation") == set()
    top, anywhere = imported("import os, numpy.linalg\nfrom PIL import Image\ndef f():\n    import h5py\n")
    assert top == {"numpy", "pillow"} and anywhere == {"numpy", "pillow", "h5py"}
    assert requirement("dask[distributed]>=2024.8") == "dask" and requirement("arviz >=0.20,<2") == "arviz"


@pytest.mark.parametrize("room", ROOMS)
def test_imports_within_hmmseg_run_downwards(room):
    """`Trial.read` alone looks up, to what judges a hand's recording: it is where users look for it."""
    above = {f"hmmseg.{name}" for name in ROOMS[: ROOMS.index(room)]}
    for path in sorted((ROOT / "hmmseg" / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                seen = ".".join(node.module.split(".")[:2])
                allowed = path.name == "trial.py" and node.module == "hmmseg.hand.read"
                assert seen not in above or allowed, f"{path.relative_to(ROOT)} imports {node.module}"


def missing(module: str, name: str) -> bool:
    found = importlib.import_module(module)
    if hasattr(found, name):
        return False
    return not hasattr(found, "__path__") or importlib.util.find_spec(f"{module}.{name}") is None


@pytest.mark.parametrize("package", ["experiments", "paper_figs"])
def test_what_is_imported_is_there(package):
    pytest.importorskip("mujoco", reason="the blind check's simulator needs the extra `check`")
    for path in sorted((ROOT / package).rglob("*.py")):
        ours = [n for n in ast.walk(tree_of(path)) if isinstance(n, ast.ImportFrom) and n.module
                and n.module.split(".")[0] in OURS]  # fmt: skip
        gone = [f"{n.module}.{each.name}" for n in ours for each in n.names if missing(n.module, each.name)]
        assert not gone, f"{path.relative_to(ROOT)} imports {', '.join(gone)}"


def requirement(text: str) -> str:
    return re.split(r"[\[<>=!~; ]", text, maxsplit=1)[0].lower()


def declared(extra: str | None = None) -> set[str]:
    project = PROJECT["project"]
    entries = project["dependencies"] if extra is None else project["optional-dependencies"][extra]
    return {requirement(entry) for entry in entries} - {"hmmseg"}


def imported(source: str) -> tuple[set[str], set[str]]:
    """Distributions that a module imports at its top, and those it imports anywhere."""
    tree = ast.parse(source)

    def names(nodes) -> set[str]:
        found = imported_packages(nodes)
        return {DISTRIBUTIONS.get(n, n) for n in found if n not in sys.stdlib_module_names and n not in LOCAL}

    return names(tree.body), names(ast.walk(tree))


def everywhere(*packages: str) -> set[str]:
    paths = [path for package in packages for path in (ROOT / package).rglob("*.py")]
    return set().union(*(imported(path.read_text(encoding="utf-8"))[1] for path in paths))


def extras() -> dict[str, set[str]]:
    return {name: declared(name) for name in PROJECT["project"]["optional-dependencies"]}


def test_the_product_and_every_extra_import_what_is_declared_and_all_of_it():
    used, optional = everywhere(*PRODUCT), set().union(*extras().values())
    assert used - optional - declared() == set(), "imported and not declared"
    assert declared() - used == set(), "declared and never imported"
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


@pytest.mark.parametrize("package", PRODUCT)
def test_every_package_says_that_it_is_typed(package):
    assert (ROOT / package / "py.typed").exists()
