"""An effect is a plug-in: what it does stands in `simgap/effects`, and no other file lists it by its name."""

import ast
from pathlib import Path

import simgap
from simgap.effects import catalogue

ROOT = Path(simgap.__file__).parent
# The comparison with given trials and robots have effects of their own, some of the same names.
CATALOGUES = {ROOT / "generic/effects.py", ROOT / "channels/drives.py"}


def named_in(path: Path, names: set[str]) -> set[str]:
    """Effects whose names stand as strings in the code of a file, alone or before what follows a dot."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    texts = (n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str))
    found = [text for text in texts if not text.endswith(".toml")]  # actual.toml is a file
    return {text.split(".")[0].split("/")[0] for text in found} & names


def test_no_file_but_those_that_define_effects_names_one():
    names, listed = set(catalogue()), {}
    for path in sorted(ROOT.rglob("*.py")):
        # What an effect is taken for, and its own keys, are said where it is defined.
        own = path.parent == ROOT / "effects" and " = HandEffect(\n" in path.read_text(encoding="utf-8")
        others = set() if own or path in CATALOGUES else named_in(path, names)
        if others:
            listed[str(path.relative_to(ROOT))] = others
    assert listed == {}
