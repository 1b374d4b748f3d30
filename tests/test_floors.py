"""Imports between the packages run only downwards."""

import ast
from pathlib import Path

import pytest

FLOORS = ("experiments", "paper_figs", "hmmseg_cli", "simgap", "estimation", "hmmseg")
ROOT = Path(__file__).resolve().parents[1]


def imported_packages(source: str) -> set[str]:
    """Top packages a module imports, inside functions too; a relative import is its own package."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
    return found


def upward(package: str, source: str) -> set[str]:
    """Packages of higher floors that a module of `package` imports."""
    return imported_packages(source) & set(FLOORS[: FLOORS.index(package)])


@pytest.mark.parametrize("package", FLOORS)
def test_imports_run_downwards(package):
    for path in sorted((ROOT / package).rglob("*.py")):
        above = upward(package, path.read_text(encoding="utf-8"))
        assert not above, f"{path.relative_to(ROOT)} imports {', '.join(sorted(above))} from above"


def test_an_upward_import_is_seen():
    assert upward("hmmseg", "def f():\n    from estimation.priors import x\n") == {"estimation"}
    assert upward("hmmseg", "import simgap.world.hand as h, hmmseg.io.task") == {"simgap"}
    assert upward("simgap", "from hmmseg import task\nimport estimation") == set()


ROOMS = ("online", "sequence", "segmentation", "hand", "contact", "io")  # of hmmseg, from the top down


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
