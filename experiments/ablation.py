"""What each special case of the segmentation and of the estimate buys: it is switched off, all else stays.

    python -m experiments.ablation [--trials 3] [--shared ../shared] [--only NAME...]

Sets: worlds of experiments/worlds.py (single trials), the recordings of `recordings`, and, where they are at
hand, a robot arm's and another simulator's. Trials of a folder are a sample by seed. Misfits are the edits of
experiments/misfit_edits.py. Writes experiments/results/ablation.json; docs/tables/special_cases.csv shows it.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from experiments.estimates import estimate
from experiments.misfit_edits import EDITS
from experiments.recordings import Case, list_cases, read_case
from experiments.saving import save
from experiments.table_text import RESULTS, load, markdown
from experiments.worlds import WORLDS, scene, trials_of
from hmmseg.hand.signals import task_space
from hmmseg.segmentation.align import segment
from hmmseg.segmentation.stretches import NONE
from simgap.world.properties import random_properties

FIRST, SEED = 119_000, 119_001  # trials and samples that nothing was chosen on
NAMES = ("20 Hz", "100 Hz", "10 Hz", "ringing 1 N", "pads 1500 N/m", "untold: lag 60 ms",
         "untold: low-pass 30 ms", "untold: pads x0.6", "untold: creep", "late finger", "tapping", "pushed",
         "slipping", "turned", "tapping, 100 Hz")  # fmt: skip
SHARED = ("panda/restack_1", "panda/pick_4", "panda/foam_restack_1", "panda/foam_pick_4",
          "recordings_general/gaps_1", "recordings_general/fast1k_1")  # fmt: skip
EDITED = ("drop_first_go_on", "drop_second", "regrasp", "no_second_move", "starts_in_grip", "stops_in_carry")
A_TENTH = 0.1

Off = tuple[str, Callable[..., Any]]
SPECIAL: dict[str, tuple[Off, ...]] = {
    "toe": (("hmmseg.segmentation.pads.find", lambda readings: NONE),),
    "lateness": (("hmmseg.segmentation.pads.lateness", lambda *a: None),),
    "brief touches": (("hmmseg.segmentation.free_contacts._tapped", lambda *a: []),),
    "ringing loads": (("hmmseg.segmentation.pads.ringing", lambda *a: []),),
    "disagreement of force and place": (("hmmseg.segmentation.changes._discrepancy", lambda *a: 0.0),),
    "slopes within grips": (("estimation.observations.slopes_within", lambda *a: {}),),
    "landing": (("estimation.observations.landing", lambda *a: None),),
    "several motions in a landing": (("hmmseg.segmentation.changes.Penetration.restless", lambda *a: 0.0),),
    "forces that lead or lag a little": (
        ("hmmseg.segmentation.posteriors.Contacts._timely", lambda contacts, c, making: c),
    ),
}


def world_cases(name: str, count: int) -> list[Case]:
    """Single trials of a world, each a case of its own."""
    task = scene()[1]
    out = []
    for number in range(FIRST, FIRST + count):
        for judged in trials_of(WORLDS[name], [number]):
            blocks = {b: {p: (getattr(found, p), 0.0) for p in ("weight", "width", "height")}
                      for b, found in random_properties(task, number).items()}  # fmt: skip
            signals = (task_space(judged.trial, judged.rig),)
            truth = (tuple(judged.boundaries),)
            out.append(Case(name, judged.rig, task, (judged.trial,), signals, truth, blocks, None))
    return out


def sampled(case: Case, count: int) -> Case:
    """A case with a sample of its trials, by seed."""
    some = np.flatnonzero([t is not None for t in case.truth])
    chosen = sorted(np.random.default_rng(SEED).permutation(some)[:count])
    return Case(case.name, case.rig, case.task, tuple(case.trials[i] for i in chosen),
                tuple(case.signals[i] for i in chosen), tuple(case.truth[i] for i in chosen), case.blocks,
                case.effects)  # fmt: skip


def sets(count: int, shared: Path) -> Iterator[tuple[str, list[Case]]]:
    """Every set by name."""
    for name in NAMES:
        yield name, world_cases(name, count)
    yield "recordings", [sampled(read_case(f), 1) for f in list_cases(Path("recordings"))]
    for name in SHARED:
        if (shared / name).is_dir():
            yield name, [sampled(read_case(shared / name), count)]


def score(cases: Sequence[Case]) -> dict[str, float]:
    """Boundary errors [s] and coverage, errors, relative sds and rms of z of properties, cases refused."""
    residuals, covered, errors, z, refused = [], [], [], [], 0
    for case in cases:
        try:
            found = estimate(case, sampled=False)
        except (ValueError, IndexError, KeyError):
            refused += 1
            continue
        residuals.append(found.residuals.ravel())
        covered.append(found.covered.ravel())
        errors.append(found.errors)
        z.append(found.z)
    if not errors:
        return {"refused": refused}
    r, e, u = (np.concatenate(v) for v in (residuals, errors, z))
    sd = np.abs(e[u != 0] / u[u != 0])
    found = {
        "median": float(np.nanmedian(np.abs(r))), "percentile_95": float(np.nanquantile(np.abs(r), 0.95)),
        "missed": int(np.isnan(r).sum()), "coverage_90": float(np.nanmean(np.concatenate(covered))),
        "error": float(np.sqrt(np.mean(e**2))), "width": float(np.exp(np.mean(np.log(sd)))),
        "z_rms": float(np.sqrt(np.mean(u**2))), "refused": refused,
    }  # fmt: skip
    return {key: value for key, value in found.items() if np.isfinite(value)}


def misfits(count: int) -> dict[str, int]:
    """Edited and healthy trials of the usual world that are judged rightly."""
    task, right, false = scene()[1], 0, 0
    for judged in trials_of(WORLDS["20 Hz"], range(FIRST, FIRST + count)):
        (found,) = segment([judged.trial], task, judged.rig)
        false += found.failed is not None
        for name in EDITED:
            trial, expected = EDITS[name](judged.trial, list(judged.boundaries))
            (found,) = segment([trial], task, judged.rig)
            right += found.failed is not None and found.failed.index == expected
    return {"right": right, "of": count * len(EDITED), "false_alarms": false}


def measured(count: int, cases: dict[str, list[Case]]) -> dict[str, Any]:
    """Scores of all sets as the code stands."""
    return {"sets": {name: score(each) for name, each in cases.items()}, "misfits": misfits(count)}


def table() -> str | None:
    """docs/tables/special_cases.csv: by how much each set gets worse without a special case, at most."""
    found = load("ablation")
    if found is None:
        return None
    full = found["full"]
    rows = []
    for name, without in found["without"].items():
        cells = []
        for key in ("median", "percentile_95", "error", "width"):
            worse = {s: without["sets"][s].get(key, np.inf) / full["sets"][s][key] - 1
                     for s in full["sets"] if full["sets"][s].get(key)}  # fmt: skip
            most = max(worse, key=lambda s: worse[s])
            size = f"{100 * worse[most]:+.0f} %" if np.isfinite(worse[most]) else "none found"
            cells.append(f"{size} ({most})")
        for key in ("coverage_90", "z_rms"):
            off = {s: without["sets"][s].get(key, np.nan) - full["sets"][s][key]
                   for s in full["sets"] if key in full["sets"][s]}  # fmt: skip
            most = max(off, key=lambda s: abs(off[s]))
            cells.append(f"{off[most]:+.2f} ({most})")
        m, f = without["misfits"], full["misfits"]
        cells.append(f"{m['right'] - f['right']:+d} of {m['of']}, alarms {m['false_alarms']}")
        rows.append([name, *cells])
    head = ["without", "boundary error, median", "95th percentile", "error of properties", "their sd",
            "90 % coverage", "rms of z", "misfits recognised"]  # fmt: skip
    note = (
        "By how much a measure grows where it grows most, by set; coverage and z where they change most. "
        f"{found['trials']} trials a set from number {FIRST} on. Commit {found['made_by']}."
    )
    return f"{markdown(head, rows)}\n\n{note}"


def main() -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--trials", type=int, default=3)
    parser.add_argument("--shared", type=Path, default=Path("../shared"))
    parser.add_argument("--only", nargs="*", metavar="NAME", help="add these to what was found before")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    cases = dict(sets(given.trials, given.shared))
    before = load("ablation") if given.only else None
    document = before or {
        "trials": given.trials, "full": measured(given.trials, cases), "without": {},
    }  # fmt: skip
    for name in given.only or SPECIAL:
        with ExitStack() as stack:
            for where, instead in SPECIAL[name]:
                stack.enter_context(patch(where, instead))
            document["without"][name] = measured(given.trials, cases)
        print(name, flush=True)
        save(RESULTS / "ablation.json", document)


if __name__ == "__main__":
    main()
