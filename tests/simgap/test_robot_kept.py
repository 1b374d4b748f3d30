"""A diagnosis that was interrupted goes on where it was, and ends on the same digits."""

from __future__ import annotations

import os

import numpy as np
import pytest

from hmmseg.cache import CacheWarning
from simgap.robots.describe import body
from simgap.robots.diagnose import diagnose
from simgap.robots.kept import Kept, kept_for, modules_beside
from simgap.simulators.recording import Recording
from simgap.simulators.user import checked

CHANNELS = {"u": {"unit": "rad", "kind": "command"}, "y": {"unit": "rad", "kind": "position", "noise": 1e-3}}
PARAMETERS = {
    "slope": {"nominal": 1.0, "sd": 0.1},
    "bend": {"nominal": 0.0, "sd": 0.1},
    "zero": {"nominal": 0.0, "sd": 1.0, "fitted": True},
}


class Curve:
    """y = zero + slope u + bend u^2; Ctrl-C comes at a run of this number."""

    parameters, channels = PARAMETERS, CHANNELS

    def __init__(self, at: int = -1) -> None:
        self.runs, self.at = 0, at

    def simulate(self, parameters, recording):
        """As the class says."""
        self.runs += 1
        if self.runs == self.at:
            raise KeyboardInterrupt
        u = recording["u"]
        return {"y": parameters["zero"] + parameters["slope"] * u + parameters["bend"] * u**2}


def logs(noise: float = 1e-3) -> list[Recording]:
    rng, out = np.random.default_rng(3), []
    for k in range(3):
        t = np.arange(0.0, 1.0, 0.02)
        u = np.sin((k + 1) * t)
        y = 0.4 + 1.2 * u + noise * rng.standard_normal(t.size)
        out.append(Recording(f"{k}.csv", t, {"u": u, "y": y}))
    return out


def run(curve: Curve, kept: Kept):
    return body(diagnose(checked(curve, "here"), logs(), kept=kept))


@pytest.fixture(scope="module")
def whole():
    curve = Curve()
    return run(curve, Kept()), curve.runs


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_it_goes_on_where_it_was_and_ends_alike(whole, share, tmp_path):
    document, count = whole
    assert document["verdict"] in ("named", "set")
    kept = Kept(tmp_path / "kept")
    with pytest.raises(KeyboardInterrupt):
        run(Curve(at=int(share * count)), kept)
    begun = kept.begun
    curve = Curve()
    assert run(curve, kept) == document
    assert begun and curve.runs < count


def test_a_finished_diagnosis_is_read_and_then_forgotten(whole, tmp_path):
    document, count = whole
    kept = Kept(tmp_path / "kept")
    assert run(Curve(), kept) == document
    curve = Curve()
    assert run(curve, kept) == document and curve.runs < 0.5 * count
    kept.forget()
    assert not kept.begun and not (tmp_path / "kept").exists()


def test_a_step_cut_short_is_made_again(tmp_path):
    kept = Kept(tmp_path)
    assert kept("one", lambda: [1, 2]) == [1, 2]
    assert kept("one", lambda: [3]) == [1, 2] and kept.of("part")("one", lambda: [3]) == [3]
    (tmp_path / "one.npz").write_bytes(b"PK cut")
    with pytest.warns(CacheWarning, match=r"one\.npz: not as it was written; made anew"):
        assert kept("one", lambda: [3]) == [3]


def test_other_inputs_have_another_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert kept_for([b"a", b"b"]).folder == kept_for([b"a", b"b"]).folder
    assert len({kept_for(k).folder for k in ([b"a", b"b"], [b"ab"], [b"b", b"a"], [b"a"])}) == 4
    kept_for([b"a"])("one", lambda: 1)
    assert kept_for([b"a"]).begun
    os.utime(kept_for([b"a"]).folder, (0, 0))
    assert not kept_for([b"a"]).begun


def test_what_a_simulator_imports_from_beside_it_counts(tmp_path, monkeypatch):
    (tmp_path / "beside_robot.py").write_text("x = 1\n")
    (tmp_path / "robot_here.py").write_text("import beside_robot\n")
    monkeypatch.syspath_prepend(tmp_path)
    __import__("robot_here")
    assert modules_beside(tmp_path / "robot_here.py") == [b"x = 1\n", b"import beside_robot\n"]
