"""Results carry the commit of the code that made them."""

import json
import subprocess

import pytest

from experiments.saving import ROOT, commit_of, save


def test_a_result_says_which_code_made_it(tmp_path):
    save(tmp_path / "new" / "found.json", {"value": 1.5})
    found = json.loads((tmp_path / "new" / "found.json").read_text())
    assert found == {"value": 1.5, "made_by": commit_of()}
    assert found["made_by"] is None or len(found["made_by"].rstrip("+")) >= 12


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
    assert clean is not None and not clean.endswith("+")
    (tmp_path / "result.json").write_text("{}\n")
    assert commit_of(tmp_path) == clean
    (tmp_path / "code.py").write_text("a = 2\n")
    assert commit_of(tmp_path) == clean + "+"


def test_nan_is_refused(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        save(tmp_path / "found.json", {"value": float("nan")})
    assert not (tmp_path / "found.json").exists()


def test_every_result_says_which_code_made_it():
    known = {"blind_seal.json"}  # a list of hashes, each with the commits that drew and diagnosed the set
    for path in sorted((ROOT / "experiments" / "results").rglob("*.json")):
        if path.name not in known:
            found = json.loads(path.read_text(encoding="utf-8"))
            assert {"made_by", "commits"} & found.keys(), path.name
