"""An effect is one file, named nowhere else: that of docs/your_effect.md is a candidate everywhere."""

import ast
import re
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from simgap_swing import Swing, log

import simgap
from experiments.generic_ensembles import TASK, ensemble
from hmmseg.io.trial import Trial
from simgap import channels, effects
from simgap.effects import catalogue
from simgap.generic import effects as of_ensembles
from simgap.generic.diagnose import diagnose
from simgap.generic.trials import align
from simgap.play.world import felt_effects
from simgap.robot_effects import candidates
from simgap.robot_effects.base import Setting
from simgap.simulators.user import checked

PAGE = Path(simgap.__file__).parents[1] / "docs" / "your_effect.md"
ROOT = Path(simgap.__file__).parent
# The comparison with given trials and robots have effects of their own, some of the same names.
CATALOGUES = {ROOT / "generic/effects.py", ROOT / "channels/drives.py"}


@pytest.fixture
def step(tmp_path, monkeypatch):
    (tmp_path / "step.py").write_text(re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)[0])
    caches = (channels.channel_effects, effects.catalogue, of_ensembles.effects)
    monkeypatch.setattr(channels, "__path__", [*channels.__path__, str(tmp_path)])
    for cache in caches:
        cache.cache_clear()
    yield channels.channel_effects()["step"]
    sys.modules.pop("simgap.channels.step", None)
    for cache in caches:
        cache.cache_clear()


def test_it_is_a_candidate_everywhere_and_taken_out_of_forces_as_it_was_put_in(step):
    mine = effects.catalogue()["force_step"]
    assert list(mine.parameters) == ["fx1", "fy1", "fx2", "fy2"] and "force_step" in felt_effects()
    assert mine.parameters["fx1"].unit == "N" and mine.parameters["fx1"].sd == pytest.approx(0.09)
    logs = [log(0), log(1)]
    robots = candidates(Setting(checked(Swing(), "Swing"), logs))["readout:angle.step"]
    sd = np.concatenate([r["angle"] for r in logs]).std()
    assert robots.parameters["step"].sd == pytest.approx(0.03 * sd)
    mine, t = effects.catalogue()["force_step"], np.linspace(0, 4, 60)
    truth = np.random.default_rng(0).standard_normal((60, 4))
    values = {"fx1": 0.1, "fy1": -0.2, "fx2": 0.0, "fy2": 0.3}
    put = mine.apply(Few(t, truth.reshape(-1, 2, 2)), values, None).force.reshape(-1, 4)
    np.testing.assert_allclose(put - truth, np.outer(t > 2, list(values.values())), atol=1e-12)
    out = mine.correct(Few(np.asarray(t)[None], np.asarray(put)[None]), values, 1.0)
    np.testing.assert_allclose(out.force[0], truth, atol=1e-12)


class Few(NamedTuple):
    """Of a performance and of a world what a reading needs."""

    t: np.ndarray
    force: np.ndarray


def test_it_is_named_in_given_trials(step):
    rng = np.random.default_rng(3)
    real, first = ensemble(rng, 6)
    sim, second = ensemble(rng, 6, name="sim")
    changed = [Trial(t.file, t.t, t.channels | {"fa": step.read(t.t, t.channels["fa"], {"step": 1.0})})
               for t in real]  # fmt: skip
    body = diagnose(align(changed, sim, TASK, boundaries=first | second)).body
    assert body["causes"] == ["force_step"]
    assert body["effects"]["force_step"]["parameters"]["fa"]["mean"] == pytest.approx(1.0, rel=0.1)


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
