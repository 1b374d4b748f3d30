"""Write a set, sealed or open.

Sealed (`generate`): user folders under cases/, what was done under sealed/, its hash for all to see. Open
(`write_open`): folders of recordings with their answers next to the trials, for scripts that judge those.
Whoever changes code by such a folder draws another one to judge the change.
"""

from __future__ import annotations

import importlib.util
import json
import secrets
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from experiments.blind_check.cases import TIERS, TOLERANCE, Case, Recorded, draw_cases, record_case
from experiments.blind_check.effects import Made
from experiments.blind_check.hand import Rig, load_rig
from experiments.blind_check.outside import OUTSIDE
from experiments.blind_check.sealing import seal

NOMINAL = Path(__file__).with_name("nominal")
MEASURED = {"weight": 5e-4, "width": 1e-4, "height": 1e-4}  # N, m, m: balance and calipers
UNITS = {"weight": "N", "width": "m", "height": "m"}


def generate(
    count: int,
    seed: int,
    out: Path,
    progress: Callable[[int, int], None] | None = None,
    outside: Mapping[str, Made] = OUTSIDE,
    shares: Mapping[str, int] = TIERS,
    fastest: float = float("inf"),
) -> str:
    """Simulate and write `count` cases; the seal's hash. What was already written is kept."""
    nominal = load_rig(NOMINAL / "rig.toml")
    labels = []
    (out / "sealed" / "parts").mkdir(parents=True, exist_ok=True)
    cases = draw_cases(count, seed, nominal, outside, shares, fastest)
    for k, case in enumerate(cases):
        part = out / "sealed" / "parts" / f"{case.name}.json"
        if not part.exists():
            try:
                trials = record_case(case, nominal, outside=outside)
            except RuntimeError:  # no hand performs it
                continue
            write_folder(out / "cases" / case.name, case, trials, nominal)
            part.write_text(json.dumps(_label(case, trials)), encoding="utf-8")
        labels.append(json.loads(part.read_text(encoding="utf-8")))
        if progress is not None:
            progress(k + 1, len(cases))
    return seal(out, {"seed": seed, "cases": labels}, secrets.token_hex(16))


def write_open(
    out: Path,
    count: int,
    seed: int,
    shares: Mapping[str, int],
    fastest: float = float("inf"),
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """OUT/CASE (rig.toml, task.toml, trial_NN.csv, truth/trial_NN.json) and OUT/labels.json.

    `shares` of the tiers as in `experiments.blind_check.cases.TIERS`; cases already written are kept.
    """
    nominal = load_rig(NOMINAL / "rig.toml")
    cases = draw_cases(count, seed, nominal, shares=shares, fastest=fastest)
    labels = []
    for k, case in enumerate(cases):
        folder = out / case.name
        if not (folder / "truth").exists():
            try:
                trials = record_case(case, nominal)
            except RuntimeError:  # no hand performs it
                continue
            write_folder(folder, case, trials, nominal)
            _write_truth(folder, trials)
        labels.append(_open_label(case))
        if progress is not None:
            progress(k + 1, count)
    (out / "labels.json").write_text(json.dumps(labels, indent=1) + "\n", encoding="utf-8")


def _write_truth(folder: Path, trials: list[Recorded]) -> None:
    (folder / "truth").mkdir()
    for k, trial in enumerate(trials):
        text = json.dumps({"boundaries": [round(b, 6) for b in trial.boundaries]})
        (folder / "truth" / f"trial_{k + 1:02d}.json").write_text(text + "\n", encoding="utf-8")


def _open_label(case: Case) -> dict:
    blocks = {
        n: {"weight": b.weight, "width": b.width, "height": b.height, "mu": b.friction}
        for n, b in case.blocks.items()
    }
    return {
        "case": case.name, "tier": case.tier, "effects": list(case.effects) or ["none"],
        "params": case.effects, "blocks": blocks, "brackets": case.world.brackets(),
        "world": asdict(case.world),
    }  # fmt: skip


def outside_of(file: Path | None) -> Mapping[str, Made]:
    """OUTSIDE of a Python file that is withheld until its set is scored, or the known kinds."""
    if file is None:
        return OUTSIDE
    spec = importlib.util.spec_from_file_location("unseen", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.OUTSIDE


def _label(case: Case, trials: list[Recorded]) -> dict:
    return {
        "case": case.name, "seed": case.seed, "tier": case.tier, "world": asdict(case.world),
        "brackets": case.world.brackets(), "subtasks": list(case.world.work.subtasks),
        "effects": case.effects, "sizes": case.sizes, "exclude": list(case.exclude),
        "measured": case.measured, "blocks": {n: asdict(b) for n, b in case.blocks.items()},
        "boundaries": [list(r.boundaries) for r in trials], "shift": [_rounded(r.shift) for r in trials],
        "spread": [_rounded(r.spread) for r in trials],
    }  # fmt: skip


def _rounded(table: dict[str, list[float]]) -> dict[str, list[float]]:
    return {k: [round(v, 3) for v in row] for k, row in table.items()}


def write_folder(folder: Path, case: Case, trials: list[Recorded], nominal: Rig) -> None:
    """Write a user's folder: rig, task, trials, and actual.toml if the blocks were measured."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(rig_toml(case, nominal), encoding="utf-8")
    (folder / "task.toml").write_text(case.world.work.toml(), encoding="utf-8")
    for k, trial in enumerate(trials):
        (folder / f"trial_{k + 1:02d}.csv").write_text(csv(trial.t, trial.columns), encoding="utf-8")
    if case.measured:
        (folder / "actual.toml").write_text(_actual(case), encoding="utf-8")
    if case.exclude:
        text = json.dumps({"exclude": list(case.exclude)}) + "\n"
        (folder / "options.json").write_text(text, encoding="utf-8")


def rig_toml(case: Case, nominal: Rig) -> str:
    """The rig as the lab states it."""
    rig = case.world.rig(nominal)
    lines = [f"rate = {rig.rate:g}", f"gravity = {rig.gravity}"]
    for i in (0, 1):
        bases, links = ([float(v) for v in a[i]] for a in (rig.bases, rig.links))
        lines += [f"[fingers.{i + 1}]", f"base = {bases}", f"links = {links}"]
    lines += ["[fingertip]", f"normal_stiffness = {rig.normal_stiffness:g}",
              f"shear_stiffness = {rig.shear_stiffness:g}"]  # fmt: skip
    noise = {"angle": rig.angle_noise, "velocity": rig.velocity_noise, "force": rig.force_noise}
    lines += ["[noise]", *(f"{k} = {v:.3g}" for k, v in noise.items())]
    if case.world.systematic:
        lines += ["[systematic]", *(f"{k} = {v:.3g}" for k, v in case.world.systematic.items())]
    if case.tier == "slight":
        lines += ["[tolerance]", *(f"{k} = {v:g}" for k, v in TOLERANCE.items())]
    return "\n".join(lines) + "\n"


def csv(times: np.ndarray, columns: Mapping[str, np.ndarray]) -> str:
    """A trial as CSV, rounded far below the noise: 1e-6 rad, 1e-4 rad/s, 1e-5 N, 1e-5 s."""
    digits = {n: 6 if n.startswith("q") else 4 if n.startswith("d") else 5 for n in columns}
    lines = [",".join(["t", *columns])]
    for k, t in enumerate(times):
        lines.append(",".join([f"{t:.5f}", *(f"{v[k]:.{digits[n]}f}" for n, v in columns.items())]))
    return "\n".join(lines) + "\n"


def _actual(case: Case) -> str:
    rng = np.random.default_rng([case.seed, 9])
    wrong = case.effects.get("actual", {})
    out = []
    for name, block in case.blocks.items():
        for prop, sd in MEASURED.items():
            value = getattr(block, prop) + wrong.get(f"{name}.{prop}", 0.0) + sd * rng.standard_normal()
            out.append(f'[{name}.{prop}]\nunit = "{UNITS[prop]}"\nvalue = {value:.6f}\nsd = {sd}\n')
    return "".join(out)
