"""Held load against known weight: bias, gain or both, decided on lifts held out.

    python -m experiments.real.way_eeg_gal FOLDER [--output FILE.json]

FOLDER holds the table of one person's 294 lifts (WAY-EEG-GAL: Luciw, Jarocka & Edin, Scientific Data
1:140047, 2014): LF_Hold is the load force [N] of both digits over 200 ms of holding, CurW the weight (1, 2, 4
for 165, 330, 660 g). Recorded = (1 + gain) weight + bias + scatter, whose sd is one for each weight. Lifts of
one run repeat each other's error, so whole runs are held out and evidence is tempered.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
from scipy.special import logsumexp
from scipy.stats import norm
from scipy.stats import t as student

from experiments.real.on_folder import run_on_folder
from hmmseg.errors import InputError

RESULTS = Path(__file__).resolve().parents[1] / "results" / "way_eeg_gal.json"
MASS = {1: 0.165, 2: 0.330, 4: 0.660}  # kg, by CurW
GRAVITY = 9.80665
MODELS: dict[str, tuple[str, ...]] = {
    "none": (), "force_bias": ("bias",), "force_gain": ("gain",), "force_bias+force_gain": ("bias", "gain"),
}  # fmt: skip
FREE = "free offset of each weight"  # the ceiling; it takes no name
MODELS[FREE] = tuple(f"offset_{code}" for code in MASS)
PRIOR = {"bias": 0.3, "gain": 0.1} | dict.fromkeys(MODELS[FREE], 0.3)  # sd [N], [1], [N]
FOLDS = 10
COLUMNS = ("Run", "Lift", "CurW", "LF_Hold")


def read(folder: Path) -> pd.DataFrame:
    """Lifts with `weight` [N], `load` [N], `cluster` (the run); InputError for a malformed folder."""
    files = sorted(folder.glob("*.csv"))
    if len(files) != 1:
        raise InputError(str(folder), f"holds {len(files)} tables", "one .csv file of lifts")
    table = pd.read_csv(files[0])
    for name in COLUMNS:
        if name not in table:
            raise InputError(f"{files[0]}: column {name}", "missing", ", ".join(COLUMNS))
    known = table["CurW"].isin(list(MASS)) & table["LF_Hold"].notna()
    if not known.all():
        row = int(np.flatnonzero(~known)[0]) + 2
        raise InputError(
            f"{files[0]}: row {row}", "no weight or no held load", "CurW of 1, 2 or 4 and LF_Hold in N"
        )
    weight = table["CurW"].map(MASS) * GRAVITY
    return pd.DataFrame({"weight": weight, "load": table["LF_Hold"], "cluster": table["Run"].astype(int)})


def design(lifts: pd.DataFrame, model: str) -> np.ndarray:
    """Columns (lifts, parameters) of a model."""
    columns = {"bias": np.ones(len(lifts)), "gain": lifts["weight"].to_numpy()}
    columns |= {f"offset_{c}": np.isclose(lifts["weight"], m * GRAVITY) * 1.0 for c, m in MASS.items()}
    return np.array([columns[p] for p in MODELS[model]]).reshape(-1, len(lifts)).T


def scatter(lifts: pd.DataFrame) -> np.ndarray:
    """Standard deviation (lifts,) of the load within each lift's weight."""
    return lifts.groupby("weight")["load"].transform("std").to_numpy()


def inflation(lifts: pd.DataFrame) -> float:
    """How many lifts are worth one, as those of one run repeat each other's error.

    The design effect of clusters: Kish, Survey Sampling, 1965, chapter 5.
    """
    rest = (lifts["load"] - lifts.groupby("weight")["load"].transform("mean")) / scatter(lifts)
    sizes = rest.groupby(lifts["cluster"]).size()
    between = rest.groupby(lifts["cluster"]).mean()
    # One-way random effects by moments: the share of variance that a run's lifts have in common.
    typical = (sizes.sum() - (sizes**2).sum() / sizes.sum()) / (len(sizes) - 1)
    high = (sizes * (between - rest.mean()) ** 2).sum() / (len(sizes) - 1)
    low = ((rest - rest.groupby(lifts["cluster"]).transform("mean")) ** 2).sum() / (sizes.sum() - len(sizes))
    shared = max((high - low) / (high + (typical - 1) * low), 0.0)
    return float(1 + (typical - 1) * shared)


def fitted(lifts: pd.DataFrame, model: str, tempered: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Posterior mean, covariance and log evidence [nats], each lift worth 1 / tempered."""
    x, sd = design(lifts, model), scatter(lifts)
    y = (lifts["load"] - lifts["weight"]).to_numpy()
    weight = 1 / (sd**2 * tempered)
    precision = x.T @ (x * weight[:, None]) + np.diag([PRIOR[p] ** -2.0 for p in MODELS[model]])
    mean = np.linalg.solve(precision, x.T @ (weight * y)) if len(precision) else np.zeros(0)
    log_evidence = -0.5 * float((weight * y**2).sum()) + 0.5 * float(mean @ precision @ mean)
    log_evidence -= sum(np.log(PRIOR[p]) for p in MODELS[model])
    if len(precision):
        log_evidence -= 0.5 * float(np.linalg.slogdet(precision)[1])
    return mean, np.linalg.inv(precision), log_evidence


def folds(lifts: pd.DataFrame) -> np.ndarray:
    """Fold (lifts,) of each lift: whole runs together."""
    runs = lifts["cluster"].unique()
    return lifts["cluster"].map({run: k % FOLDS for k, run in enumerate(runs)}).to_numpy()


def held_out(lifts: pd.DataFrame, model: str, tempered: float) -> np.ndarray:
    """Log predictive density (lifts,) of every lift [nats] from the lifts of other runs."""
    label, out, sd = folds(lifts), np.zeros(len(lifts)), scatter(lifts)
    for fold in np.unique(label):
        inside = label == fold
        mean, covariance, _ = fitted(lifts[~inside], model, tempered)
        x = design(lifts[inside], model)
        spread = np.sqrt(sd[inside] ** 2 + np.einsum("ij,jk,ik->i", x, covariance, x))
        out[inside] = norm.logpdf((lifts["load"] - lifts["weight"])[inside], x @ mean, spread)
    return out


def weights_alone(lifts: pd.DataFrame) -> list[dict]:
    """For each weight: offset of the held load, its scatter, and intervals from scatter alone."""
    out = []
    for weight, group in lifts.groupby("weight"):
        n, mean, sd = len(group), float(group["load"].mean()), float(group["load"].std())
        reach = float(student.isf(0.025, n - 1)) * sd / np.sqrt(n)
        out.append({
            "weight": float(weight), "lifts": n, "mean_load": mean, "offset": mean - float(weight),
            "sd_between_lifts": sd, "interval_95_from_scatter": [mean - reach, mean + reach],
            "covers": bool(mean - reach <= weight <= mean + reach),
            "offset_in_standard_errors": float((mean - weight) / (sd / np.sqrt(n))),
            "single_lift_95_covers": float((np.abs(group["load"] - weight) < 1.96 * sd).mean()),
        })  # fmt: skip
    return out


def corrected(lifts: pd.DataFrame, model: str, tempered: float) -> dict:
    """Weights from the held load of lifts in one run, the sensor calibrated on other runs.

    Relative error and coverage of 95 % intervals, with the scatter alone and with the calibration's own
    uncertainty and scatter.
    """
    label, error, inside = folds(lifts), [], []
    sd = scatter(lifts)
    for fold in np.unique(label):
        mine = label == fold
        mean, covariance, _ = fitted(lifts[~mine], model, tempered)
        values = dict(zip(MODELS[model], mean, strict=True))
        scale = 1 + values.get("gain", 0.0)
        estimate = (lifts["load"][mine] - values.get("bias", 0.0)) / scale
        x = design(lifts[mine], model)
        spread = np.sqrt(sd[mine] ** 2 + np.einsum("ij,jk,ik->i", x, covariance, x)) / scale
        error.append((estimate / lifts["weight"][mine] - 1).to_numpy())
        inside.append((np.abs(estimate - lifts["weight"][mine]) < 1.96 * spread).to_numpy())
    return {"rms_relative_error": float(np.sqrt(np.mean(np.concatenate(error) ** 2))),
            "coverage_95": float(np.mean(np.concatenate(inside)))}  # fmt: skip


def run(folder: Path) -> dict:
    """All results."""
    lifts = read(folder)
    tempered = inflation(lifts)
    base = held_out(lifts, "none", tempered)
    models = {}
    for model, parameters in MODELS.items():
        mean, covariance, log_evidence = fitted(lifts, model, tempered)
        sd = np.sqrt(np.diag(covariance))
        score = held_out(lifts, model, tempered)
        models[model] = {
            "log_evidence": log_evidence, "heldout_score": float((score - base).sum()),
            "parameters": {
                p: {"mean": float(m), "sd": float(s),
                    "interval_90": [float(m - 1.645 * s), float(m + 1.645 * s)],
                    "unit": "1" if p == "gain" else "N"}
                for p, m, s in zip(parameters, mean, sd, strict=True)
            },
            "weights": None if model == FREE else corrected(lifts, model, tempered),
        }  # fmt: skip
    named = [m for name, m in models.items() if name != FREE]
    evidence, nothing = np.array([m["log_evidence"] for m in named]), models["none"]["log_evidence"]
    for model, share in zip(named, np.exp(evidence - logsumexp(evidence)), strict=True):
        model["probability"] = float(share)
    for model in models.values():
        model["log_evidence"] -= nothing
    both = held_out(lifts, "force_bias+force_gain", tempered)
    runs = lifts["cluster"]
    against = {}
    for name in ("force_bias", "force_gain", FREE):
        by_run = pd.Series(both - held_out(lifts, name, tempered)).groupby(runs).sum()
        n = len(by_run)
        reach = float(student.isf(0.05, n - 1)) * by_run.std() * np.sqrt(n)
        total = float(by_run.sum())
        against[name] = {"nats": total, "interval_90": [total - reach, total + reach]}
    return {
        "format": "experiments.way_eeg_gal/1", "lifts": len(lifts), "runs": int(runs.nunique()),
        "lifts_worth_one": tempered,
        "chosen": max((m for m in models if m != FREE), key=lambda m: models[m]["heldout_score"]),
        "models": models, "both_over_others_held_out": against, "scatter_alone": weights_alone(lifts),
    }  # fmt: skip


def main() -> None:
    """Run on a folder and write the results."""
    run_on_folder(__doc__, run, RESULTS)


if __name__ == "__main__":
    main()
