"""What is published stays as pinned and says where it comes from: results, constants and tables."""

import copy
import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

import experiments.constants as table
from experiments.blind_check.tables import fresh
from experiments.calibration import Estimates, summarise_estimates
from experiments.golden import KINDS, differences, folders, read, rounded
from experiments.saving import commit_of, save
from experiments.worlds import Deviations, deviated, scene, simulated_cases
from experiments.write_tables import TABLES, fill
from hmmseg.hand.signals import task_space

ROOT = Path(__file__).parents[2]


def test_tables_are_filled_between_markers_and_no_spent_blind_set_is_a_result(monkeypatch):
    text = "a\n<!-- x -->\nold\n<!-- /x -->\nb\n<!-- y -->\n<!-- /y -->\n"
    once = fill(text, "x", "| new \\1 |")
    assert once == "a\n<!-- x -->\n\n| new \\1 |\n\n<!-- /x -->\nb\n<!-- y -->\n<!-- /y -->\n"
    assert fill(once, "x", "| new \\1 |") == once
    with pytest.raises(ValueError, match="no markers <!-- z -->"):
        fill(text, "z", "table")
    seals = {"blind_check": {"seal": {"sha256": "a"}}, "blind_sets": {"sets": [{"seal": "a"}]}}
    monkeypatch.setattr("experiments.blind_check.tables.load", seals.get)
    assert fresh() is None
    seals["blind_sets"] = {"sets": [{"seal": "b"}]}
    assert fresh() is seals["blind_check"]


def test_every_table_has_what_writes_it_and_a_target():
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    marked = {(str(page.relative_to(ROOT)), name) for page in pages
              for name in re.findall(r"^<!-- (\w+) -->$", page.read_text(encoding="utf-8"),
                                     re.MULTILINE)}  # fmt: skip
    assert marked - {("docs/reproduction.md", "results")} == {(page, name) for page, name, *_ in TABLES
                                                              if name}  # fmt: skip
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in {target for *_, target in TABLES}:
        assert re.search(rf"^{target}: ", makefile, re.MULTILINE), target
    for module in re.findall(r"python -m ((?:experiments|paper_figs)[\w.]*)", makefile):
        path = ROOT / Path(*module.split("."))
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), module
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    shown = [*(ROOT / "docs/figures").iterdir(), *(ROOT / "docs/tables").iterdir()]
    assert [path.name for path in shown if f"{path.parent.name}/{path.name}" not in text] == []


def test_coverages_have_clusters_as_their_units():
    names = (("block", "weight"), ("block", "width"))

    def one(z, ranks, release):
        inside, errors = np.array([[1.0, 0.0, 1.0, release]]), np.array([0.01, -0.03])
        return Estimates(np.zeros((1, 4)), inside, names, errors, np.array(z), np.array(ranks), 1.0, 1000.0)

    cases = [[one([0.5, 3.0], [0.5, 0.999], np.nan)], [one([0.1, -0.2], [0.4, 0.1], 0.0)]]
    found = summarise_estimates(cases)
    assert found["boundaries"]["all"]["coverage_90"] == pytest.approx(4 / 7)  # one is unknown
    assert found["boundaries"]["lift"]["coverage_90"] == 0.0
    weight, every = found["properties"]["weight"], found["properties"]["all"]
    assert weight["rms"] == pytest.approx(0.01) and weight["coverage_68"] == 1.0
    assert every["coverage_95"] == 0.75 and every["laplace_95"] == 0.75
    # Cases cover 1/2 and 2/2: their mean has a standard error of half the difference.
    assert every["coverage_95_se"] == pytest.approx(0.25)


def hand(**deviations):
    zero = {"force_bias": 4, "force_gain": 4, "joint_offset": 4, "link_length": 4, "pad_stiffness": 2}
    return Deviations(**{k: np.zeros(n) + deviations.get(k, 0.0) for k, n in zero.items()})


@pytest.fixture(scope="module")
def trial():
    return simulated_cases(1, trials=1, seed=20_990)[0].trials[0]


def test_deviated_hands_are_read_by_rigs_that_know_their_links_gains_biases_and_pads(trial):
    rig, _ = scene()
    changed = deviated(trial, rig, hand(link_length=0.01, joint_offset=0.002))
    true = {i: f.model_copy(update={"links": tuple(1.01 * x for x in f.links)})
            for i, f in rig.fingers.items()}  # fmt: skip
    channels = {k: v - 0.002 if k.startswith("q") else v for k, v in changed.channels.items()}
    knowing = task_space(type(trial)(trial.file, trial.t, channels), rig.model_copy(update={"fingers": true}))
    expected = task_space(trial, rig)
    for name in ("x1", "y1", "x2", "y2", "vx1", "vy2"):
        np.testing.assert_allclose(getattr(knowing, name), getattr(expected, name), atol=1e-9)
    changed = deviated(trial, rig, hand(force_gain=0.1, force_bias=0.05, pad_stiffness=1.0))
    np.testing.assert_allclose(changed.channels["fx1"], 1.1 * trial.channels["fx1"] + 0.05)
    before, after = task_space(trial, rig), task_space(changed, rig)
    # Twice the stiffness halves the give: tips under grip N lie N / (2 k) further back.
    give = trial.channels["fx1"] / (2 * rig.fingertip.normal_stiffness)
    np.testing.assert_allclose(before.x1 - after.x1, give, atol=1e-9)


def test_every_constant_has_a_kind_and_a_reason_as_its_comment_means_it(tmp_path, monkeypatch):
    assert [f"{c.file}: {c.name}" for c in table.every() if c.kind == "unstated" or not c.reason] == []
    monkeypatch.setattr(table, "ROOT", tmp_path)
    (tmp_path / "module.py").write_text("# physics: m/s^2\nGRAVITY = 9.81\n"
                                        "FEWEST = 6  # chosen: samples of a window\n"
                                        "# prior: s on either side\n"
                                        "REACH = 0.03\n"
                                        "LONG = 4.0  # numerics: goes on\n# below it\n"
                                        "NAMES = ('a', 'b')\nBARE = 3.0\n")  # fmt: skip
    found = [(c.name, c.value, c.kind, c.reason) for c in table.constants(tmp_path / "module.py")]
    assert found == [("GRAVITY", "9.81", "physics", "m/s^2"),
                     ("FEWEST", "6", "chosen", "samples of a window"),
                     ("REACH", "0.03", "prior", "s on either side"),
                     ("LONG", "4.0", "numerics", "goes on below it"),
                     ("BARE", "3.0", "unstated", "")]  # fmt: skip


def test_results_say_which_code_made_them_and_nan_is_refused(tmp_path):
    save(tmp_path / "new" / "found.json", {"value": 1.5})
    found = json.loads((tmp_path / "new" / "found.json").read_text())
    assert found == {"value": 1.5, "made_by": commit_of()}
    assert found["made_by"] is None or len(found["made_by"].rstrip("+")) >= 12
    with pytest.raises(ValueError, match="not JSON compliant"):
        save(tmp_path / "found.json", {"value": float("nan")})
    assert not (tmp_path / "found.json").exists()
    known = {"blind_seal.json"}  # a list of hashes, each with the commits that drew and diagnosed the set
    for path in sorted((ROOT / "experiments" / "results").rglob("*.json")):
        if path.name not in known:
            found = json.loads(path.read_text(encoding="utf-8"))
            assert {"made_by", "commits"} & found.keys(), path.name


def test_changed_code_is_told(tmp_path):
    def git(*words: str) -> None:
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", *who, *words], cwd=tmp_path, check=True, capture_output=True)

    assert commit_of(tmp_path) is None
    git("init")
    (tmp_path / "code.py").write_text("a = 1\n")
    git("add", ".")
    git("commit", "-m", "first")
    clean = commit_of(tmp_path)
    assert not clean.endswith("+")
    (tmp_path / "result.json").write_text("{}\n")
    assert commit_of(tmp_path) == clean
    (tmp_path / "code.py").write_text("a = 2\n")
    assert commit_of(tmp_path) == clean + "+"


FAST = "none_1"


def same(kind: str, name: str) -> None:
    assert list(differences(read(kind)[name], rounded(KINDS[kind][1](name)))) == []


def test_what_is_pinned_stays_in_every_folder_but_for_a_share_of_its_sd():
    same("identified", FAST)
    for kind in ("identified", "diagnosed"):
        assert sorted(read(kind)) == folders()
    old = read("identified")["none_1"]
    for name, (mean, sd) in old["properties"].items():
        for shift, found in ((0.2, 0), (0.3, 1)):
            new = copy.deepcopy(old)
            new["properties"][name] = [mean + shift * sd, sd]
            assert len(list(differences(old, new))) == found


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in folders() if name != FAST])
def test_boundaries_and_properties_of_the_other_folders(name: str):
    same("identified", name)


@pytest.mark.slow
@pytest.mark.parametrize("kind, name", [(k, n) for k in ("diagnosed", "ensembles") for n in read(k)])
def test_verdicts_shares_and_parameters_are_those_pinned(kind: str, name: str):
    same(kind, name)


@pytest.mark.parametrize("path, by", [
    (("identified", "none_1", "boundaries", 0, 3, 0), 2e-3),
    (("diagnosed", "force_bias_1", "shares", "force_bias"), 0.06),
    (("diagnosed", "force_bias_1", "shrinkage"), -0.06)])  # fmt: skip
def test_what_moves_by_more_than_it_may_is_seen(path: tuple, by: float):
    old = read(path[0])[path[1]]
    new = copy.deepcopy(old)
    place = new
    for key in path[2:-1]:
        place = place[key]
    place[path[-1]] += by
    assert len(list(differences(old, new))) == 1
    place[path[-1]] -= 0.9 * by
    assert list(differences(old, new)) == [] and len(list(differences(old, new, exact=True))) == 1
