"""Do intervals hold wherever the tool is used? Properties and boundaries in worlds that differ, a row each.

    python -m experiments.calibration_worlds [--rows NAME...] [--replicates 16] [--fresh]

Every replicate has blocks, an operator's hand and noise of its own, from seeds that nothing was chosen on;
worlds of one pace share performances, so that rows differ by their world alone. Resumable: a row that
stands in the results with as many replicates is kept. Writes experiments/results/calibration_worlds.json,
which docs/calibration.md shows, and docs/figures/calibration_worlds.png.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments.saving import save
from experiments.world_scores import Replicate, line, score, summary
from experiments.worlds import GRASP_SPREAD, Cell, deviated, disturbed, draw_deviations, recording_rig, scene
from hmmseg.io.rig import Fingertip, Noise, Rig, Systematic
from hmmseg.io.task import BlockTask, parse_task
from hmmseg.io.trial import Trial
from simgap.gap.twins import recorded
from simgap.world.operator import OperatorSettings
from simgap.world.properties import random_properties
from simgap.world.simulate import SimulatedTrial, simulate_trials

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "calibration_worlds.json"
FIRST, REPLICATES = 116_000, 32
SHEAR_SHARE = 0.625  # shear over normal stiffness of the usual pads
BIAS = 0.02  # N, what [systematic] admits where a row has biases
PADS = 0.3  # share, likewise of pads
PANELS = (
    ("95", "properties, 95 %", (92, 97)), ("68", "properties, 68 %", (63, 73)),
    ("90", "boundaries, 90 %", (86, 94)),
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One world: `cell` as in the sweeps; a tower of `blocks` reversed (one: moved), `trials` pooled.

    `pads` [N/m]; `stated`: noise as the rig has it, over what it is; `coloured`: lag-one correlation of
    the noise; `bias`: of every force, in units of what [systematic] admits (BIAS); `softer`: pads' true
    stiffness over the rig's, which admits PADS in [systematic] if `doubted`; `deviating`: a hand drawn
    from a [systematic] table.
    """

    name: str
    cell: Cell = field(default_factory=Cell)
    blocks: int = 2
    trials: int = 1
    pads: float = 4000.0
    stated: float = 1.0
    coloured: float = 0.0
    bias: float = 0.0
    softer: float = 1.0
    doubted: bool = False
    deviating: bool = False


def _rows() -> list[Row]:
    out = [Row("as usual")]
    out += [Row(f"{r:g} Hz", Cell(rate=r)) for r in (10.0, 50.0, 200.0, 2000.0)]
    out += [Row(f"pace {p:g}", Cell(pace=p)) for p in (0.5, 3.0)]
    out += [Row(f"noise x{n:g}", Cell(noise=n)) for n in (0.25, 4.0, 16.0)]
    out += [Row(f"ringing {v:g} N", Cell(vibration=v)) for v in (0.3, 1.0)]
    out += [Row(f"pads {k:g} N/m", pads=k) for k in (1500.0, 12000.0)]
    out += [Row("missing 40 %", Cell(missing=0.4))]
    out += [Row(f"noise stated x{s:g}", stated=s) for s in (0.5, 2.0)]
    out += [Row("noise AR(1) 0.5", coloured=0.5)]
    out += [Row("bias as admitted", bias=1.0), Row("bias twice that", bias=2.0)]
    out += [
        Row("pads 30 % off, admitted", softer=0.7, doubted=True),
        Row("pads 30 % off, untold", softer=0.7),
    ]
    out += [Row("hand as [systematic]", deviating=True)]
    out += [Row("1 block", blocks=1), Row("3 blocks", blocks=3), Row("6 blocks", blocks=6)]
    out += [Row("4 trials", trials=4), Row("20 trials", trials=20)]
    return out


ROWS = {row.name: row for row in _rows()}
HAND = Systematic(force_bias=(0.01,) * 4, force_gain=(0.01,) * 4, joint_offset=(0.001,) * 4,
                  link_length=(0.001,) * 4, pad_stiffness=(0.1, 0.1))  # fmt: skip


def task_of(blocks: int) -> BlockTask:
    """A tower of so many blocks reversed; one block is moved on the ground."""
    if blocks == 2:
        return scene()[1]
    names = [f"b{k}" for k in range(blocks)]
    under = {name: on for name, on in zip(names, [*names[1:], "ground"], strict=True)}
    moves = [{"object": name, "to": "ground" if k == 0 else names[k - 1]} for k, name in enumerate(names)]
    task = parse_task({"objects": {n: {"on": on} for n, on in under.items()}, "moves": moves})
    assert isinstance(task, BlockTask)
    return task


def replicates(row: Row, num: int) -> Iterator[Replicate]:
    """`num` replicates of a row; each number the same whatever its company."""
    task, nominal = task_of(row.blocks), _rig(row)
    numbers = range(FIRST, FIRST + num)
    done = _performed(row.cell.pace, row.pads * row.softer, row.blocks, row.trials, num)
    sensors = recording_rig(row.cell, nominal)
    for i, number in enumerate(numbers):
        mine = done[i * row.trials : (i + 1) * row.trials]
        trials = [_recorded(row, s, task, sensors, number) for s in mine]
        yield Replicate(task, _told(row, sensors), trials, [s.boundaries for s in mine],
                        dict(mine[0].blocks))  # fmt: skip


def _rig(row: Row) -> Rig:
    pads = Fingertip(normal_stiffness=row.pads, shear_stiffness=SHEAR_SHARE * row.pads)
    return scene()[0].model_copy(update={"fingertip": pads})


@lru_cache(maxsize=2)
def _performed(pace: float, pads: float, blocks: int, trials: int, num: int) -> list[SimulatedTrial]:
    """What truly happened; rows that differ by their sensors alone share it."""
    rig, task = _rig(Row("", pads=pads)), task_of(blocks)
    operator = OperatorSettings(pace=(pace, pace), grasp=(-GRASP_SPREAD, GRASP_SPREAD))
    drawn = [random_properties(task, FIRST + i) for i in range(num)]
    seeds = [100 * (FIRST + i) + k for i in range(num) for k in range(trials)]
    return simulate_trials(task, rig, [b for b in drawn for _ in range(trials)], seeds, operator)


def _recorded(row: Row, simulated: SimulatedTrial, task: BlockTask, rig: Rig, number: int) -> Trial:
    t = np.arange(int(simulated.t[-1] * row.cell.rate)) / row.cell.rate
    resampled = replace(simulated, trial=replace(simulated.trial, t=t))
    trial = recorded(resampled, task, rig, {})
    if row.coloured:
        quiet = {name: sd * 1e-9 for name, sd in rig.noise.model_dump(exclude_none=True).items()}
        clean = recorded(resampled, task, rig.model_copy(update={"noise": Noise(**quiet)}), {})
        trial = _coloured(trial, clean, row.coloured)
    trial = disturbed(trial, simulated.boundaries, row.cell, simulated.seed)
    rng = np.random.default_rng([number, 6])  # of the hand: all trials of a replicate alike
    if row.bias:
        signs = row.bias * BIAS * rng.choice([-1.0, 1.0], 4)
        shifted = {n: trial.channels[n] + b for n, b in zip(("fx1", "fy1", "fx2", "fy2"), signs, strict=True)}
        trial = replace(trial, channels=trial.channels | shifted)
    return deviated(trial, rig, draw_deviations(HAND, rng)) if row.deviating else trial


def _coloured(noisy: Trial, clean: Trial, rho: float) -> Trial:
    """The trial with its noise made AR(1), of the same variance."""
    channels = {}
    for name, values in noisy.channels.items():
        white = values - clean.channels[name]
        noise = np.empty_like(white)
        noise[0] = white[0]
        for k in range(1, white.size):
            noise[k] = rho * noise[k - 1] + np.sqrt(1 - rho**2) * white[k]
        channels[name] = clean.channels[name] + noise
    return replace(noisy, channels=channels)


def _told(row: Row, sensors: Rig) -> Rig:
    """What the estimator is told of the hand."""
    noise = {name: sd * row.stated for name, sd in sensors.noise.model_dump(exclude_none=True).items()}
    told = sensors.model_copy(update={"noise": Noise(**noise)})
    if row.bias:
        told = told.model_copy(update={"systematic": Systematic(force_bias=(BIAS,) * 4)})
    if row.doubted:
        told = told.model_copy(update={"systematic": Systematic(pad_stiffness=(PADS, PADS))})
    return told.model_copy(update={"systematic": HAND}) if row.deviating else told


def draw(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """A panel for each level, a line for each world; grey is what is to be reached."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(10, 0.26 * len(rows) + 1.2), sharey=True, layout="constrained")
    names = list(rows)
    for ax, (key, title, (low, high)) in zip(axes, PANELS, strict=True):
        ax.axvspan(low, high, color="0.88", lw=0)
        for y, name in enumerate(names):
            share, error = rows[name][f"coverage_{key}"], rows[name][f"se_{key}"]
            if share is None:
                continue
            inside = low - 200 * error <= 100 * share <= high + 200 * error
            ax.errorbar(100 * share, y, xerr=100 * error, fmt="o", ms=3.5, lw=1,
                        color="C0" if inside else "C3")  # fmt: skip
        ax.set_title(title, fontsize=9)
        ax.set_xlim(30 if key == "68" else 55, 101)
        ax.tick_params(labelsize=8)
        ax.set_xlabel("true values inside [%]", fontsize=8)
        ax.grid(axis="x", lw=0.3)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", nargs="*", default=list(ROWS), metavar="NAME")
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--fresh", action="store_true", help="score every row anew")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args(arguments)
    document: dict[str, Any] = {"first": FIRST, "rows": {}}
    if options.output.exists() and not options.fresh:
        document = json.loads(options.output.read_text(encoding="utf-8"))
    for name in options.rows:
        num = max(2, options.replicates // 2) if ROWS[name].trials > 4 else options.replicates
        if document["rows"].get(name, {}).get("replicates", 0) < num:
            scored = [score(found) for found in replicates(ROWS[name], num)]
            document["rows"][name] = summary(scored) | {"seconds": sum(s["seconds"] for s in scored)}
            document["rows"] = {n: document["rows"][n] for n in ROWS if n in document["rows"]}
            save(options.output, document)
        print(line(name, document["rows"][name]), flush=True)
    draw(document["rows"], HERE.parent / "docs" / "figures" / "calibration_worlds.png")


if __name__ == "__main__":
    main()
