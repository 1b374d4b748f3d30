"""How often the diagnosis is right on our own simulator, and how sure it may be.

    python -m experiments.gap_calibration RECORDINGS/CASE [--rounds N] [--folder results/gap_calibration]
    python -m experiments.gap_calibration --learn [--folder results/gap_calibration]

CASE gives rig.toml and task.toml; its recordings are not read. Every case is diagnosed and its
document kept as one line of FOLDER/cases.jsonl; finished cases are not repeated. `--learn` takes from
them how far the parameters of each effect are off and when "unknown" is likelier than the best
candidate, and writes both to simgap/gap/bank.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from experiments.gap_cases import draw_case, plan
from hmmseg.errors import InputError
from hmmseg.io.rig import read_rig
from hmmseg.io.task import BlockTask, read_task
from simgap.gap import bank as store
from simgap.gap.diagnose import diagnose
from simgap.gap.judge import DEFAULT_MISFIT, Calibration
from simgap.gap.locate import together
from simgap.gap.verdict import likelihoods

RARE = 0.4  # weight of a case from outside: the bank has as many as of the catalogue, the world fewer
WEAK = np.array([3.0, 2.0, 1.0, 1.5, 1.0])  # sd of a weak prior about the first guess of each constant


def finished(file: Path) -> dict[str, dict[str, Any]]:
    """Rows of the store by case."""
    if not file.exists():
        return {}
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    return {row["case"]: row for row in rows}


def run(folder: Path, rounds: int, rig, task: BlockTask, first: int = 5000, count: int | None = None) -> None:
    """Draw and diagnose all cases of the plan that are not in the store yet."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "cases.jsonl"
    done = finished(file)
    for kind, effects, seed in plan(rounds, first)[:count]:
        name = f"{kind}_{'+'.join(effects) or 'none'}_{seed}"
        if name in done:
            continue
        try:
            case = draw_case(kind, effects, seed, task, rig)
        except (InputError, ValueError) as error:  # a motion that this hand cannot make
            print(name, "not drawn:", error, file=sys.stderr)
            continue
        told = {"case": name, "effects": case.effects, "values": case.values, "excluded": case.excluded}
        start = time.perf_counter()
        try:
            found = diagnose(case.trials, task, rig, excluded=case.excluded)
        except InputError as error:
            row = {**told, "refused": str(error)}
        else:
            row = {
                **told, "size": case.size, "seconds": time.perf_counter() - start, "body": found.body,
                "warnings": found.warnings,
                "scores": found.scores,
            }  # fmt: skip
        with file.open("a", encoding="utf-8") as sink:
            sink.write(json.dumps(row) + "\n")
        body = row.get("body", {})
        print(name, f"{case.size:.2f}", body.get("verdict", "refused"), body.get("causes"),
              body.get("indistinguishable"), f"{row.get('seconds', 0):.0f} s", flush=True)  # fmt: skip


def named_right(row: dict[str, Any]) -> bool:
    """Whether a case of one effect was named, alone or in a set."""
    body = row.get("body", {"causes": [], "indistinguishable": []})
    return len(row["effects"]) == 1 and body["causes"] == list(row["effects"])


def misfits(rows: Sequence[dict[str, Any]], before: Calibration) -> dict[str, float]:
    """By effect, the rms share by which parameters miss beyond their own sd (that of a few cases shrunk).

    Pooled over effects it is the share that two further cases would have had.
    """
    squares: dict[str, list[float]] = {}
    for row in filter(named_right, rows):
        (name,) = row["effects"]
        for key, truth in row["values"][name].items():
            found = row["body"]["effects"][name]["parameters"].get(key)
            if found is not None and truth != 0.0:
                share = before.misfit.get(name, DEFAULT_MISFIT) if before.misfit else 0.0
                own = max(found["sd"] ** 2 - (share * found["mean"]) ** 2, 0.0)
                squares.setdefault(name, []).append(max((found["mean"] - truth) ** 2 - own, 0.0) / truth**2)
    usual = np.median([np.mean(np.minimum(v, 0.04)) for v in squares.values()])
    return {
        n: round(float(np.sqrt((np.sum(np.minimum(v, 0.04)) + 2 * usual) / (len(v) + 2))), 4)
        for n, v in sorted(squares.items())
    }


def unknown(rows: Sequence[dict[str, Any]], start: Calibration) -> Calibration:
    """The calibration of "unknown" and of the prior with the largest mean log probability of the truth."""

    def placed(x: np.ndarray) -> Calibration:
        at, width = np.exp(x[1:3])
        return replace(start, prior=round(float(x[0]), 2), unknown_at=round(float(at), 4),
                       unknown_width=round(float(width), 3), unknown_slope=round(float(x[3]), 3),
                       unknown_coarse=round(float(np.exp(x[4])), 2))  # fmt: skip

    def log_score(x: np.ndarray) -> float:
        c = placed(x)
        total = 0.0
        for row in rows:
            if "scores" not in row:
                continue
            s = row["scores"]
            p = likelihoods(s["evidence"], together(s["p"]), s["left"], s["p_left"], c)
            alien = row["excluded"] or any(n.startswith("outside:") for n in row["effects"])
            right = "unknown" if alien else "+".join(row["effects"]) or "none"
            total += (RARE if alien else 1.0) * np.log(max(p.get(right, 0.0), 0.01))
        return -total + 0.5 * float((((x - first) / WEAK) ** 2).sum())

    first = np.array([-4.0, np.log(0.05), np.log(0.6), 1.0, 1.0])
    simplex = first + np.vstack([np.zeros(5), np.diag([2.0, -1.0, 0.7, 1.0, 1.0])])
    best = minimize(log_score, first, method="Nelder-Mead",
                    options={"initial_simplex": simplex, "maxiter": 2000})  # fmt: skip
    return placed(best.x)


def learn(folder: Path) -> None:
    """Take the calibration from the store and write it to the bank."""
    rows = list(finished(folder / "cases.jsonl").values())
    bank = store.load_bank()
    found = unknown(rows, replace(bank.calibration, misfit=misfits(rows, bank.calibration)))
    store.FILE.write_text(replace(bank, calibration=found).to_json(), encoding="utf-8")
    print(len(rows), "cases:", found)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("case", type=Path, nargs="?")
    parser.add_argument("--learn", action="store_true")
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--first", type=int, default=5000)
    parser.add_argument("--count", type=int)
    parser.add_argument("--folder", type=Path, default=Path("results/gap_calibration"))
    given = parser.parse_args(arguments)
    if given.learn:
        learn(given.folder)
        return 0
    if given.case is None:
        parser.error("a CASE with rig.toml and task.toml is needed")
    task = read_task(given.case / "task.toml")
    if not isinstance(task, BlockTask):
        raise SystemExit("a task of blocks is needed")
    run(given.folder, given.rounds, read_rig(given.case / "rig.toml"), task, given.first, given.count)
    return 0


if __name__ == "__main__":
    sys.exit(main())
