"""Write a sealed set: user folders under cases/, what was done under sealed/, its hash for all to see."""

from __future__ import annotations

import json
import secrets
from dataclasses import asdict
from pathlib import Path

import numpy as np

from experiments.blind_check.cases import Case, Recorded, draw_cases, record_case
from experiments.blind_check.hand import load_rig
from experiments.blind_check.sealing import seal

NOMINAL = Path(__file__).with_name("nominal")
MEASURED = {"weight": 5e-4, "width": 1e-4, "height": 1e-4}  # N, m, m: balance and calipers
UNITS = {"weight": "N", "width": "m", "height": "m"}


def generate(count: int, seed: int, out: Path, progress=None) -> str:
    """Simulate and write `count` cases; the seal's hash. What was already written is kept."""
    rig = load_rig(NOMINAL / "rig.toml")
    labels = []
    (out / "sealed" / "parts").mkdir(parents=True, exist_ok=True)
    cases = draw_cases(count, seed)
    for k, case in enumerate(cases):
        part = out / "sealed" / "parts" / f"{case.name}.json"
        if not part.exists():
            trials = record_case(case, rig)
            write_folder(out / "cases" / case.name, case, trials)
            part.write_text(json.dumps(_label(case, trials)), encoding="utf-8")
        labels.append(json.loads(part.read_text(encoding="utf-8")))
        if progress is not None:
            progress(k + 1, len(cases))
    return seal(out, {"seed": seed, "cases": labels}, secrets.token_hex(16))


def _label(case: Case, trials: list[Recorded]) -> dict:
    return {
        "case": case.name,
        "seed": case.seed,
        "tier": case.tier,
        "effects": case.effects,
        "sizes": case.sizes,
        "exclude": list(case.exclude),
        "measured": case.measured,
        "blocks": {n: asdict(b) for n, b in case.blocks.items()},
        "boundaries": [list(r.boundaries) for r in trials],
        "shift": [_rounded(r.shift) for r in trials],
        "spread": [_rounded(r.spread) for r in trials],
    }


def _rounded(table: dict[str, list[float]]) -> dict[str, list[float]]:
    return {k: [round(v, 3) for v in row] for k, row in table.items()}


def write_folder(folder: Path, case: Case, trials: list[Recorded]) -> None:
    """What a user has: rig, task, trials, and actual.toml where the blocks were measured."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("rig.toml", "task.toml"):
        (folder / name).write_bytes((NOMINAL / name).read_bytes())
    for k, trial in enumerate(trials):
        (folder / f"trial_{k + 1:02d}.csv").write_text(_csv(trial), encoding="utf-8")
    if case.measured:
        (folder / "actual.toml").write_text(_actual(case), encoding="utf-8")
    if case.exclude:
        text = json.dumps({"exclude": list(case.exclude)}) + "\n"
        (folder / "options.json").write_text(text, encoding="utf-8")


def _csv(trial: Recorded) -> str:
    """Digits far below the noise: 1e-5 rad, 1e-3 rad/s, 1e-4 N."""
    digits = {n: 5 if n.startswith("q") else 3 if n.startswith("d") else 4 for n in trial.columns}
    lines = [",".join(["t", *trial.columns])]
    for k, t in enumerate(trial.t):
        lines.append(",".join([f"{t:.4g}", *(f"{v[k]:.{digits[n]}f}" for n, v in trial.columns.items())]))
    return "\n".join(lines) + "\n"


def _actual(case: Case) -> str:
    rng = np.random.default_rng([case.seed, 9])
    out = []
    for name, block in case.blocks.items():
        for prop, sd in MEASURED.items():
            value = getattr(block, prop) + sd * rng.standard_normal()
            out.append(f'[{name}.{prop}]\nunit = "{UNITS[prop]}"\nvalue = {value:.6f}\nsd = {sd}\n')
    return "".join(out)
