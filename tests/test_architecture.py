"""What pages say of files is true, imports run downwards, and what scripts import is there."""

import ast
import importlib
import importlib.util
import re
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


def defined(path: Path) -> set[str]:
    """Names of classes that a file defines, types given a name included."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef):
            found.add(node.name)
    return found


def table_rows() -> list[tuple[str, str]]:
    """Types and the file in which the page says they stand."""
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \|(?: [^|]+ \|)?? `([\w/]+\.py)` \|", text, re.MULTILINE)
    return [(name, file) for names, file in rows for name in re.findall(r"[A-Z]\w+", names)]


def test_every_type_stands_where_the_page_says():
    assert len(table_rows()) >= 14
    assert [(name, file) for name, file in table_rows() if name not in defined(ROOT / file)] == []


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


def test_an_upward_import_is_seen():
    assert upward("hmmseg", "def f():\n    from estimation.priors import x\n") == {"estimation"}
    assert upward("hmmseg", "import simgap.world.hand as h, hmmseg.io.task") == {"simgap"}
    assert upward("simgap", "from hmmseg import task\nimport estimation") == set()


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


def imported_names(path: Path) -> list[tuple[str, str]]:
    """Module and name of everything of ours that a file imports by name."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OURS:
            found += [(node.module, alias.name) for alias in node.names]
    return found


def missing(module: str, name: str) -> bool:
    """Whether a module has no such name and no such submodule."""
    found = importlib.import_module(module)
    if hasattr(found, name):
        return False
    return not hasattr(found, "__path__") or importlib.util.find_spec(f"{module}.{name}") is None


@pytest.mark.parametrize("package", ["experiments", "paper_figs"])
def test_what_is_imported_is_there(package):
    pytest.importorskip("mujoco", reason="the blind check's simulator needs the extra `check`")
    for path in sorted((ROOT / package).rglob("*.py")):
        gone = [f"{module}.{name}" for module, name in imported_names(path) if missing(module, name)]
        assert not gone, f"{path.relative_to(ROOT)} imports {', '.join(gone)}"
