"""Imports between the packages run only downwards."""

from __future__ import annotations

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
