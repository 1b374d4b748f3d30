"""What each test that a cause has to pass buys by itself: verdicts with all of them, and without one.

    python -m experiments.gap_detectors FOLDER [FOLDER ...]

Case folders have labels.json beside them; made-up ensembles (experiments.generic_ensembles) are judged along
with them. No healthy twins are taken, and what acts together is not linearised anew. Writes
experiments/results/gap_detectors.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.blind_check.diagnose import read_folder
from experiments.gap_generic import made
from experiments.generic_ensembles import PLANTED
from experiments.saving import save
from experiments.table_text import load, markdown
from hmmseg.jaxconfig import double_precision
from simgap.attribution import attribute as engine
from simgap.attribution.attribute import Attribution
from simgap.attribution.heldout import Invariance
from simgap.attribution.posterior import forms
from simgap.attribution.problem import Gap
from simgap.attribution.search import sought
from simgap.gap.problem import properties_tolerated
from simgap.gap.search import search
from simgap.generic.diagnose import find_ring, scene, searched
from simgap.generic.trials import both, layout

RESULT = Path(__file__).parent / "results" / "gap_detectors.json"
SURE = Invariance(50.0, 1.0, 0.0, None, None)  # type: ignore[arg-type]

# What takes the place of each test where it is left out.
WITHOUT: dict[str, dict[str, Any]] = {
    "all": {},
    "same everywhere": {"_same": lambda f, model, effect: SURE},
    "held-out trials": {"_predicting": lambda others, causes: causes},
    "what has no name": {
        "_by_name": lambda f, models, *rest: {
            m.effects: tuple(j for j in m.effects if f.gap.candidates[j].named) for m in models
        }
    },
    "least share": {"LEAST": 0.0},
    "blocks turn": {},
}


@contextmanager
def left_out(what: str) -> Iterator[None]:
    """The engine without one of its tests."""
    kept = {name: getattr(engine, name) for name in WITHOUT[what]}
    for name, other in WITHOUT[what].items():
        setattr(engine, name, other)
    try:
        yield
    finally:
        for name, own in kept.items():
            setattr(engine, name, own)


def verdicts(gap: Gap, **more: Any) -> dict[str, str]:
    """The verdict on a gap with all tests, and without each."""
    out, models = {}, sought(forms(gap))
    for what in WITHOUT:
        given, known = gap, models
        if what == "blocks turn":
            loose = [c.name == "table_tilt" for c in gap.candidates]
            if not any(loose):
                continue
            given = replace(gap, candidates=tuple(
                replace(c, frees=None) if one else c for c, one in zip(gap.candidates, loose, strict=True)
            ))  # fmt: skip
            known = sought(forms(given))
        with left_out(what):
            try:
                out[what] = said(engine.attribute(given, None, models=known, **more))
            except np.linalg.LinAlgError:  # what a test keeps away may have no answer
                out[what] = "no answer"
    return out


def said(found: Attribution) -> str:
    """A verdict in short."""
    return " + ".join(found.causes) + " in a set" * (found.verdict == "set") or found.verdict


@double_precision
def blocks(folder: Path) -> dict[str, str]:
    """Verdicts on a folder of recordings."""
    found = search(*read_folder(folder))
    return verdicts(found.gap, absorbed=properties_tolerated(found.problem))


def ensembles(effect: str) -> dict[str, str]:
    """Verdicts on made-up ensembles with one effect."""
    lay = layout(made(7, None if effect == "none" else {effect: PLANTED[effect]}, False))
    given = scene(lay)
    return verdicts(searched(replace(given, ring=find_ring(given)), *both(lay))[1])


def table() -> str | None:
    """docs/attribution.md: cases of which a verdict changes, and how many there were."""
    found = load("gap_detectors")
    if not isinstance(found, dict):
        return None
    rows = [
        [row["case"], row["true"], row["verdicts"]["all"],
         "; ".join(f"{what}: {v}" for what, v in row["verdicts"].items() if v != row["verdicts"]["all"])]
        for row in found["rows"]
    ]  # fmt: skip
    changed = [row for row in rows if row[3]]
    return (
        markdown(["case", "true", "with all tests", "without"], changed)
        + f"\n\nNo test changes the verdict on the other {len(rows) - len(changed)} of {len(rows)} cases."
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    rows: list[dict[str, Any]] = []

    def take(case: str, true: str, judged: Callable[[], dict[str, str]]) -> None:
        rows.append({"case": case, "true": true, "verdicts": judged()})
        print(rows[-1], flush=True)
        save(RESULT, {"rows": rows})

    for effect in ("none", *PLANTED):
        take("ensembles", effect, lambda effect=effect: ensembles(effect))
    for folder in parser.parse_args(arguments).folders:
        labels = json.loads((folder.parent / "labels.json").read_text(encoding="utf-8"))
        true = next(one["effects"] for one in labels if one["case"] == folder.name)
        name = f"{folder.parent.name.removeprefix('recordings_')} {folder.name.removeprefix('case_')}"
        take(name, " + ".join(true), lambda folder=folder: blocks(folder))


if __name__ == "__main__":
    main()
