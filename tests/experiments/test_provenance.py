"""Every table and figure of the pages is made by a make target, and nothing is listed that is not there."""

import re
from pathlib import Path

from experiments.provenance import FIGURES
from experiments.write_tables import TABLES, fill, targets

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
GENERATED = {("docs/architecture.md", "targets")}


def test_every_table_of_a_page_has_what_writes_it():
    marked = {
        (str(page.relative_to(ROOT)), name)
        for page in PAGES
        for name in re.findall(r"^<!-- (\w+) -->$", page.read_text(encoding="utf-8"), re.MULTILINE)
    }
    assert (
        marked - {("docs/reproduction.md", "results")}
        == {(page, name) for page, name, *_ in TABLES} | GENERATED
    )


def test_every_figure_is_made_by_one_target_and_shown():
    drawn = {path.stem for path in (ROOT / "docs" / "figures").iterdir()}
    listed = [name for names in FIGURES.values() for name in names]
    assert sorted(drawn) == sorted(listed)
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert [name for name in listed if f"figures/{name}." not in text] == []


def test_every_target_is_in_the_makefile_and_runs_what_it_says():
    for target in {target for *_, target in TABLES} | FIGURES.keys():
        assert re.search(rf"^{target}: ", MAKEFILE, re.MULTILINE), target
    for module in re.findall(r"python -m ((?:experiments|paper_figs)[\w.]*)", MAKEFILE):
        path = ROOT / Path(*module.split("."))
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), module


def test_the_table_of_targets_is_of_this_code():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert fill(text, "targets", targets()) == text
