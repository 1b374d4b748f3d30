"""docs/architecture.md and what other pages say of files are true of the code."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
TREES = ("hmmseg", "estimation", "simgap", "hmmseg_cli", "experiments", "paper_figs", "tests")
PATH = re.compile(rf"(?<![\w/.])((?:{'|'.join(TREES)})/[\w/]+\.(?:py|json|toml|j2|html))\b")


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


def test_the_page_names_types_and_their_files():
    assert len(table_rows()) >= 14


@pytest.mark.parametrize(("name", "file"), table_rows())
def test_every_type_stands_where_the_page_says(name, file):
    assert name in defined(ROOT / file)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_files_that_pages_name_are_there(page):
    named = set(PATH.findall(page.read_text(encoding="utf-8")))
    assert {file for file in named if "NAME" not in file and not (ROOT / file).exists()} == set()


@pytest.mark.parametrize("tree", TREES)
def test_no_module_is_longer_than_one_idea_takes(tree):
    lines = {path: path.read_text(encoding="utf-8").count("\n") for path in (ROOT / tree).rglob("*.py")}
    assert lines and {str(path): count for path, count in lines.items() if count > 700} == {}
