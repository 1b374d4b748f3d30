"""Names that scripts import, inside functions too, are there: no type checker reads the experiments."""

import ast
import importlib
import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OURS = ("hmmseg", "estimation", "simgap", "hmmseg_cli", "experiments", "paper_figs")


def imported(path: Path) -> list[tuple[str, str]]:
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
        gone = [f"{module}.{name}" for module, name in imported(path) if missing(module, name)]
        assert not gone, f"{path.relative_to(ROOT)} imports {', '.join(gone)}"


def test_what_is_gone_is_seen():
    assert missing("hmmseg.io.rig", "no_such_name")
    assert not missing("hmmseg.io", "rig")
