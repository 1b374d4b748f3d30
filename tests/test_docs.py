"""Examples run: docstrings, and blocks `python` and `console` of pages unless a comment says `not run`."""

import doctest
import importlib
import re
import shlex
import shutil
from pathlib import Path

import pytest

from hmmseg import example_folder
from hmmseg_cli.main import main

ROOT = Path(__file__).resolve().parents[1]
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


def test_what_is_not_run_is_left_out():
    left_out = "<!-- not run: it needs a robot -->\n```python\nb\n```\n```toml\nc\n```\n"
    text = "```python\na\n```\n" + left_out + "```console\n$ hmmseg\n```\n"
    assert blocks(text) == [("python", "a\n"), ("console", "$ hmmseg\n")]
