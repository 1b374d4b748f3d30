"""Every table and figure of the pages is made by a make target, and nothing is listed that is not there."""

import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments.provenance import FIGURES, PAGES_OF
from experiments.stamps import stamp_of, stamped
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


def test_pages_that_scripts_write_whole_are_listed():
    text = {page.stem: page.read_text(encoding="utf-8") for page in PAGES}
    for target, page in PAGES_OF.items():
        assert f"make {target}" in text[page], page
        assert re.search(rf"^{target}: ", MAKEFILE, re.MULTILINE), target


@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "figures").iterdir()), ids=lambda path: path.name)
def test_every_figure_names_the_commit_that_made_it(path):
    assert re.fullmatch(r"[0-9a-f]{7,12}\+?", stamp_of(path.read_bytes()) or "")


@pytest.mark.parametrize("kind", ["PNG", "GIF"])
def test_a_stamp_is_replaced_and_leaves_the_picture_alone(kind):
    plain = io.BytesIO()
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 255, (8, 9), dtype=np.uint8))
    picture.save(plain, kind)
    assert stamp_of(plain.getvalue()) is None
    once = stamped(plain.getvalue(), "0123456789ab")
    twice = stamped(once, "ba9876543210+")
    assert stamp_of(once) == "0123456789ab" and stamp_of(twice) == "ba9876543210+"
    assert len(twice) == len(once) + 1
    for data in (once, twice):
        np.testing.assert_array_equal(Image.open(io.BytesIO(data)).convert("L"), picture)
    with pytest.raises(ValueError, match="neither"):
        stamped(b"<svg>", "0123456789ab")
