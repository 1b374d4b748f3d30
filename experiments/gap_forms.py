"""How far effects are from their own forms: what the true one leaves, and whether that is a share of it.

    python -m experiments.gap_forms FOLDER [FOLDER ...]

For every case folder of one known effect (labels.json beside it) the effect is taken for certain.
`remainder`: root of the excess squares that it leaves over the squares of what it shifts. `share`: in every
channel, part and band the effect may act by another share e ~ N(0, rho^2) than in the mean; the likeliest
rho, and what it gains over rho = 0 [nats], the variance of each group integrated out as in the evidence.
`inertia` [g]: of the pads, as the nuisance has it. Writes experiments/results/gap_forms.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.blind_check.diagnose import read_folder
from experiments.saving import save
from experiments.table_text import load, markdown, percent
from hmmseg.jaxconfig import double_precision
from simgap.attribution.posterior import Forms, Model, coordinates, fitted, forms
from simgap.gap.nuisances import BEYOND, inertia_column
from simgap.gap.search import search

RESULT = Path(__file__).parent / "results" / "gap_forms.json"
SHARES = np.array([0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4])  # numerics: grid of rho


@double_precision
def measured(folder: Path, label: dict[str, Any]) -> dict[str, Any] | None:
    """One case's row; None where no form of its effect shifts anything."""
    (effect,) = label["effects"]
    found = search(*read_folder(folder))
    f = forms(found.gap)
    mine = [j for j, c in enumerate(found.gap.candidates) if c.name == effect and c.at.size]
    if not mine:
        return None
    model = max((fitted(f, (j,)) for j in mine), key=lambda m: m.score)
    size, along = _shift(f, model)
    excess = np.maximum(model.energy - f.count, 0.0)
    nats = np.array([_density(f, model, size, along, rho) for rho in SHARES])
    best, place = int(nats.argmax()), inertia_column(found.problem)
    return {
        "set": folder.parent.name, "case": folder.name, "effect": effect,
        "remainder": float(np.sqrt(excess.sum() / max(float(size.sum()), 1e-9))),
        "share": float(SHARES[best]), "gain": float(nats[best] - nats[0]),
        "inertia": [1e3 * BEYOND * float(model.x[place]),
                    1e3 * BEYOND * float(np.sqrt(model.covariance[place, place]))],
    }  # fmt: skip


def _shift(f: Forms, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Squares (G,) of what the effect shifts in each group, and its products (G,) with what is left."""
    (effect,) = model.effects
    own, z = f.spectrum.own[effect], f.spectrum.num_nuisances
    shift, left = np.zeros(f.product.shape[1]), np.zeros(f.product.shape[1])
    shift[own] = 1.0, *model.x[coordinates(f, model.effects)[effect]]
    left[0], left[1 : 1 + z] = 1.0, -model.x[:z]
    pushed = f.product @ shift
    return np.maximum(pushed @ shift, 0.0), pushed @ (left - shift)


def _density(f: Forms, model: Model, size: np.ndarray, along: np.ndarray, rho: float) -> float:
    """Log density of all groups where the effect acts by another share in each."""
    log_phi = f.background.log_phi[:, None]
    more = 1 + rho**2 * size * np.exp(-log_phi)
    energy = model.energy - (rho * along) ** 2 * np.exp(-log_phi) / more
    each = f.background.log_prior[:, None] - 0.5 * (
        f.count * log_phi + energy * np.exp(-log_phi) + np.log(more)
    )
    return float(np.logaddexp.reduce(each, axis=0).sum())


def table() -> str | None:
    """docs/gap_results.md: what true effects leave of their own shift."""
    found = load("gap_forms")
    if not isinstance(found, dict):
        return None
    rows = [
        [r["set"], r["case"], r["effect"], percent(r["remainder"], 0), percent(r["share"], 0),
         f"{r['gain']:.1f}", "{:.1f} ({:.1f})".format(*r["inertia"])]
        for r in found["rows"]
    ]  # fmt: skip
    head = ["set", "case", "effect", "left of its shift, rms", "share that varies", "nats", "inertia, sd [g]"]
    return markdown(head, rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    rows = []
    for folder in parser.parse_args(arguments).folders:
        labels = json.loads((folder.parent / "labels.json").read_text(encoding="utf-8"))
        found = measured(folder, next(one for one in labels if one["case"] == folder.name))
        if found is not None:
            rows.append(found)
            print(found, flush=True)
            save(RESULT, {"rows": rows})


if __name__ == "__main__":
    main()
