"""Healthy trials in which hands do what hands do, with their true boundaries: one folder a row of the table.

Each folder is a user's (rig.toml, task.toml, trial_NN.csv) with truth.json beside it: a list of boundaries
[s] a trial, four a move (both touch, leaves, meets, one lets go).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.blind_check.cases import Case, draw_blocks
from experiments.blind_check.generate import NOMINAL, csv, rig_toml
from experiments.blind_check.hand import load_rig
from experiments.blind_check.operator import Style, plan
from experiments.blind_check.perform import perform
from experiments.blind_check.scene import World
from experiments.blind_check.signals import sample, sense
from experiments.blind_check.untidy import KINDS
from experiments.blind_check.worlds import Circumstances

Row = tuple[Circumstances, Callable[[Style], Style], Callable[[World], World]]
SAME = lambda x: x  # noqa: E731
TRIES = 40


def rows() -> dict[str, Row]:
    """What is untidy in each row: circumstances, and changes of style and world."""
    usual = Circumstances()
    out: dict[str, Row] = {
        "tidy": (usual, SAME, SAME),
        "apart_60": (replace(usual, stagger=0.06), SAME, SAME),
        "apart_100": (replace(usual, stagger=0.1), SAME, SAME),
        "turning": (
            replace(usual, pad_turning=0.1),
            lambda s: replace(s, height=(-0.002, 0.002), uneven=(-0.0015, 0.0015)),
            SAME,
        ),
        "slope": (replace(usual, pad_turning=0.3), SAME, lambda w: replace(w, tilt=0.04)),
    }
    for kind in KINDS:
        style = lambda s, kind=kind: replace(s, untidy=(kind,))  # noqa: E731
        world = {
            "slip": lambda w: replace(w, pad_friction=0.4),
            "table": lambda w: replace(w, touches_table=True),
        }
        out[kind] = (usual, style, world.get(kind, SAME))
    return out


def write_untidy(out: Path, trials: int, seed: int, rates: tuple[float, ...] = (20.0, 100.0)) -> list[str]:
    """Write OUT/KIND_RATEhz for every row and rate; their names."""
    nominal, names = load_rig(NOMINAL / "rig.toml"), []
    for number, (kind, (lab, style, world)) in enumerate(rows().items()):
        for rate in rates:
            rng = np.random.default_rng([seed, number, int(rate)])
            here = replace(lab, rate=rate)
            case = Case(kind, seed, "untidy", here, draw_blocks(here, rng), {}, {}, False, ())
            folder = out / f"{kind}_{rate:g}hz"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "rig.toml").write_text(rig_toml(case, nominal), encoding="utf-8")
            (folder / "task.toml").write_text(here.work.toml(), encoding="utf-8")
            truth = []
            for k in range(trials):
                motion = _performed(case, style(here.style()), world(here.world()), rng)
                signals = sense(motion, here.rig(nominal), [], rng)
                t, columns = sample(signals, here.sampling(), rng)
                (folder / f"trial_{k + 1:02d}.csv").write_text(csv(t, columns), encoding="utf-8")
                truth.append(list(motion.boundaries))
            (folder / "truth.json").write_text(json.dumps({"boundaries": truth}) + "\n", encoding="utf-8")
            names.append(folder.name)
    return names


def _performed(case: Case, style: Style, world: World, rng: np.random.Generator):
    for _ in range(TRIES):
        try:
            return perform(plan(case.world.work, case.blocks, world, style, rng), case.blocks, world)
        except ValueError:  # dropped: people try again
            continue
    raise RuntimeError(f"{case.name}: no trial came off")
