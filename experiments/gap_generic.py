"""The generic diagnosis on made-up ensembles: false alarms, planted effects, intervals.

    python -m experiments.gap_generic [--healthy N] [--planted N] [--aligned N] [--output FILE.json]

Six real and six simulated trials a case. `healthy`: both kinds alike, boundaries given; `aligned`: the
same, boundaries found by the HMM; `planted`: cases of each effect. Sizes scatter by a quarter.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.progress import track
from scipy.stats import beta

from experiments.generic_ensembles import PLANTED, TASK, ensemble
from experiments.saving import save
from simgap.attribution.verdict import ALARM
from simgap.generic.diagnose import detect, diagnosed
from simgap.generic.trials import Ensembles, align

RESULTS = Path(__file__).resolve().parent / "results" / "gap_generic.json"
TRIALS = 6
VARIED = 0.25  # relative sd of a planted size


def made(seed: int, effects: dict | None, aligned: bool) -> Ensembles:
    """A made-up case, cut into subtasks."""
    rng = np.random.default_rng(seed)
    real, first = ensemble(rng, TRIALS, effects)
    sim, second = ensemble(rng, TRIALS, None, name="sim")
    return align(real, sim, TASK, None, None if aligned else first | second)


def upper(count: int, total: int) -> float:
    """Upper 95 % bound of a rate (Clopper & Pearson, Biometrika 26, 1934)."""
    return 1.0 if count == total else float(beta.ppf(0.95, count + 1, total - count))


def alarms(count: int, aligned: bool, start: int) -> dict:
    """How often two ensembles alike are called different."""
    seeds = track(range(start, start + count), f"healthy, aligned: {aligned}")
    found = [detect(made(seed, None, aligned), seed) for seed in seeds]
    p = np.array(found)
    false = int((p < ALARM).sum())
    return {"cases": count, "false_alarms": false, "upper_95": upper(false, count),
            "share_p_below_0.05": float((p < 0.05).mean())}  # fmt: skip


def varied(name: str, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of a case: the frequency and all sizes vary."""
    factor = float(np.exp(VARIED * rng.standard_normal()))
    values = dict(PLANTED[name])
    key = "gain" if "gain" in values else "value"
    values[key] = values[key] ** factor if name == "timing" else values[key] * factor
    if "frequency" in values:
        values["frequency"] *= float(np.exp(0.2 * rng.standard_normal()))
    return values


def recovered(name: str, body: dict, values: dict[str, float]) -> list[tuple[float, bool]]:
    """Relative error and coverage of every planted parameter, from the entry of that effect alone."""
    entry = body["effects"].get(name)
    if entry is None:
        return []
    keys = {"timing": {"press": "value"}, "structural_vibration": {k: k for k in values}}
    out = []
    for reported, given in keys.get(name, {"fa": "value"}).items():
        p, true = entry["parameters"][reported], values[given]
        out.append((p["mean"] / true - 1, p["interval_90"][0] <= true <= p["interval_90"][1]))
    return out


def planted(name: str, count: int, start: int) -> dict:
    """Verdicts and parameters where one effect is planted."""
    right = alone = unknown = 0
    rows, fractions = [], []
    for k in track(range(count), name):
        rng = np.random.default_rng([start, k])
        values = varied(name, rng)
        body = diagnosed(made(start + k, {name: values}, False), (), start + k, lambda text: None).body
        causes = {*body["causes"], *body["indistinguishable"]}
        right += name in causes
        alone += body["causes"] == [name] and not body["indistinguishable"]
        unknown += body["verdict"] == "unknown"
        rows += recovered(name, body, values)
        if body["shrinkage"] is not None:
            fractions.append(body["shrinkage"]["fraction"])
    error = np.array([r[0] for r in rows])
    return {"cases": count, "named_or_in_set": right, "named_alone": alone, "unknown": unknown,
            "parameters": len(rows), "median_abs_relative_error": float(np.median(np.abs(error))),
            "coverage_90": float(np.mean([r[1] for r in rows])),
            "median_shrinkage": float(np.median(fractions)) if fractions else None,
            }  # fmt: skip


def main() -> None:
    """Run all and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--healthy", type=int, default=200)
    parser.add_argument("--aligned", type=int, default=20)
    parser.add_argument("--planted", type=int, default=8)
    parser.add_argument("--output", type=Path, default=RESULTS)
    a = parser.parse_args()
    document = {
        "format": "experiments.gap_generic/1",
        "trials": TRIALS,
        "healthy": alarms(a.healthy, False, 10_000),
        "healthy_aligned": alarms(a.aligned, True, 20_000),
        "planted": {name: planted(name, a.planted, 30_000 + 100 * k) for k, name in enumerate(PLANTED)},
    }
    save(a.output, document)


if __name__ == "__main__":
    main()
