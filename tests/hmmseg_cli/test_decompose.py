"""`hmmseg decompose`: its JSON, its table and the paper's equation 1 as text."""

import json

import pytest

from hmmseg.example import example_folder
from hmmseg_cli.main import main

PAPER = (example_folder() / "task.toml").read_text(encoding="utf-8")


@pytest.fixture
def decomposed(tmp_path, capsys, monkeypatch):
    """Run the command on a task's text; returns its document and what people see."""

    monkeypatch.setenv("COLUMNS", "120")

    def run(text: str) -> tuple[dict, str]:
        (tmp_path / "task.toml").write_text(text)
        assert main(["decompose", str(tmp_path / "task.toml"), "--json", str(tmp_path / "out.json")]) == 0
        printed = capsys.readouterr()
        assert printed.err == ""
        return json.loads((tmp_path / "out.json").read_text()), printed.out

    return run


def test_equation_1_of_the_paper(decomposed):
    document, printed = decomposed(PAPER)
    assert document["equation"].split(",\n      ")[:4] == [
        "T = { Pregrasp 1 = (free-motion, {∅})",
        "Pickup 1 = (hold-on-ground 1, {height 2, friction 1})",
        "Carry 1 = (hold-above-ground 1, {weight 1, width 1, friction 1})",
        "Place 1 = (hold-on-ground 1, {height 2, friction 1})",
    ]
    assert document["equation"].endswith("Release 2 = (free-motion, {∅}) }")
    assert document["equation"] in printed
    assert "block1: weight in carry block1; " in printed.partition("┏")[0]  # in words first
    (row,) = (line for line in printed.splitlines() if "│ carry block1" in line)
    cells = [cell.strip() for cell in row.split("│")]
    assert cells[3:7] == ["hold-above-ground", "vertical", "horizontal", ""]


def test_document_of_the_paper(decomposed):
    document, _ = decomposed(PAPER)
    assert document["minimal"] == list(range(9))
    assert document["height_equations"] == [
        {"move": 1, "rise": {"block2": -1}},
        {"move": 2, "rise": {"block1": 1}},
    ]
    assert (document["reasons"], document["notes"], document["repeat"]) == ({}, [], 1)
    pickup = document["subtasks"][1]
    assert {key: pickup[key] for key in ("index", "subtask", "object", "state", "move", "support")} == {
        "index": 1, "subtask": "pickup", "object": "block1", "state": "hold-on-ground", "move": 1,
        "support": "block2"}  # fmt: skip
    assert pickup["constraints"] == ["block1-block2", "finger1-block1", "finger2-block1"]
    assert [entry["property"] for entry in pickup["properties"] if entry["in_paper"]] == [
        "block2.height", "block1.friction"]  # fmt: skip
    assert pickup["properties"][1] == {
        "property": "block2.height", "signals": ["vertical positions"], "with": [3], "kind": "value",
        "given": [], "condition": None, "in_paper": True}  # fmt: skip
    assert document["properties"]["block1"]["weight"] == {
        "kind": "value", "evidence": [{"subtasks": [2], "signals": ["vertical forces"], "kind": "value",
                                       "given": [], "condition": None}]}  # fmt: skip


def test_names_reasons_and_notes(decomposed):
    document, printed = decomposed(
        'repeat = "unknown"\n[objects.cup]\non = "ground"\n[objects.lid]\non = "ground"\n'
        '[[moves]]\nobject = "cup"\nto = "ground"\nslide = true\n'
    )
    assert (
        "Slide cup = (sliding-on-ground cup, {friction cup, friction on ground cup})" in document["equation"]
    )
    assert document["properties"]["lid"]["weight"] is None
    assert document["reasons"]["lid.weight"] == "no recorded move grips lid"
    assert document["properties"]["cup"]["friction_on_ground"]["kind"] == "value"
    assert document["repeat"] == "unknown"
    assert "one round is decomposed" in printed
    assert "lid.weight: no recorded move grips lid" in printed


def test_plain_ordered_task(decomposed):
    document, printed = decomposed('sequence = ["approach", "mating"]')
    assert document["equation"] == "T = { approach = (approach, {∅}),\n      mating = (mating, {∅}) }"
    assert document["properties"] == {}
    assert document["notes"] == ["a plain ordered task has no block physics: no properties"]
    assert "height_equations" not in document
    assert "approach" in printed
