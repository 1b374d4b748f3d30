"""What pyproject.toml declares is what the code imports."""

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest
from test_architecture import imported_packages

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PRODUCT = tuple(PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])
OURS = {*PRODUCT, "experiments", "paper_figs", "tests"}
# Import names that differ from the name that is installed.
DISTRIBUTIONS = {"PIL": "pillow", "mcap_ros2": "mcap-ros2-support", "sklearn": "scikit-learn"}
TOOLS = {"ipykernel", "build", "furo", "myst-parser", "pre-commit", "pyright", "pytest-xdist", "ruff",
         "sphinx"}  # fmt: skip


def requirement(text: str) -> str:
    """The distribution's name of a requirement such as `dask[distributed]>=2024.8`."""
    return re.split(r"[\[<>=!~; ]", text, maxsplit=1)[0].lower()


def declared(extra: str | None = None) -> set[str]:
    """Distributions of the project, or of one extra."""
    project = PROJECT["project"]
    entries = project["dependencies"] if extra is None else project["optional-dependencies"][extra]
    return {requirement(entry) for entry in entries} - {"hmmseg"}


def imported(source: str) -> tuple[set[str], set[str]]:
    """Distributions that a module imports at its top, and those it imports anywhere."""
    tree = ast.parse(source)

    def names(nodes) -> set[str]:
        found = imported_packages(nodes)
        return {DISTRIBUTIONS.get(n, n) for n in found if n not in sys.stdlib_module_names and n not in OURS}

    return names(tree.body), names(ast.walk(tree))


def sources(*packages: str) -> list[Path]:
    return [path for package in packages for path in sorted((ROOT / package).rglob("*.py"))]


def everywhere(*packages: str) -> set[str]:
    return set().union(*(imported(path.read_text(encoding="utf-8"))[1] for path in sources(*packages)))


def extras() -> dict[str, set[str]]:
    return {name: declared(name) for name in PROJECT["project"]["optional-dependencies"]}


def test_the_product_imports_what_is_declared_and_all_of_it():
    used, optional = everywhere(*PRODUCT), set().union(*extras().values())
    assert used - optional - declared() == set(), "imported and not declared"
    assert declared() - used == set(), "declared and never imported"


def test_every_extra_is_imported_by_something():
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


def test_what_is_imported_is_seen():
    top, anywhere = imported("import os, numpy.linalg\nfrom PIL import Image\ndef f():\n    import h5py\n")
    assert top == {"numpy", "pillow"} and anywhere == {"numpy", "pillow", "h5py"}
    assert requirement("dask[distributed]>=2024.8") == "dask" and requirement("arviz >=0.20,<2") == "arviz"
