"""Slip in the grip that would explain the paper's height of block 1, which is 1.5 mm too large.

    python -m experiments.paper.slip

Moving block 2 onto block 1 gives block 1's height as the rise of the fingers from pickup to place.
Fingers stand at a height u over the block they hold; where u differs between the two,

    estimate - height = u(place) - u(pickup) = slip + change of net vertical force / (2 shear stiffness),

and moving block 1 to the ground gives block 2's height with the opposite sign. So 1.5 mm long
means that the block slid 1.5 mm down between the fingers before it was let go.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np

from estimation import identify
from estimation.paper_formulas import estimate_plugin
from experiments.paper.rigid import by_formula
from experiments.paper.sources import BLOCKS, PRINTED, recorded, save
from experiments.recordings import Case
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import Rig
from hmmseg.io.task import GROUND, BlockTask, Move
from hmmseg.segmentation.thresholds import segment_qualitative
from simgap.world.dynamics import CONTROL_PERIOD, Record
from simgap.world.operator import minimum_jerk
from simgap.world.properties import PAPER_BLOCKS
from simgap.world.simulate import SimulatedTrial, record, simulate_trials
from simgap.world.virtual_model import physics, rollout, standing, substeps_for

STACK = BlockTask({"block1": GROUND, "block2": GROUND}, (Move("block2", "block1"),))
PLACES = {"block1": 0.15, "block2": 0.11}  # m
GRIP = 2.5  # N, as recorded
RISE, OPENING = 0.035, 0.012  # m
CLOSE, LIFT, TRAVEL, LOWER, LOAD, OPEN = 0.5, 1.2, 1.7, 2.4, 3.0, 3.6  # s, when each motion begins
DURATION = 4.2  # s
PASSES = 5  # iterations to find where the sliding block will touch down
LIGHT = 1e-4  # m beyond the touch: the fingers rest the block's weight and press by half a newton
# Friction over what a hanging block needs, 2 mu N / weight.
HOLDING = np.concatenate([np.linspace(1.105, 1.145, 9), [1.16, 1.2, 1.3]])
OVERTRAVEL = np.linspace(1e-4, 2.4e-3, 12)  # m
PERFORMED = (1.2, 0.3, 0.2, 0.16, 0.13)  # friction of whole virtual trials
IMPACT = 2.0  # N; the largest net vertical force of its Figure 6
MARGIN = 0.03  # s; about a boundary, left out of the means


@dataclass(frozen=True)
class Placed:
    """One stacking: slip [m] between pickup and place, residual of the paper's height [m], its course."""

    friction: float
    slip: float
    residual: float
    t: np.ndarray
    sliding: np.ndarray
    height: np.ndarray


def finger_path(target: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tips and velocities (T, 2, 2): grip block 2, lift it, set it on block 1 with the tips at `target`."""
    block, squeeze = PAPER_BLOCKS["block2"], GRIP / 4000.0
    start = block.height / 2

    def go(at: float, duration: float, way: float) -> np.ndarray:
        return way * minimum_jerk((t - at) / duration)

    top = start + RISE
    y = start + go(LIFT, 0.375, RISE) + go(LOWER, 0.5, target - top) + go(LOAD, 0.3, -LIGHT)
    x = PLACES["block2"] + go(TRAVEL, 0.6, PLACES["block1"] - PLACES["block2"])
    shut = OPENING + 2 * squeeze
    gap = block.width + OPENING + go(CLOSE, 0.22, -shut) + go(OPEN, 0.2, shut)
    tips = np.stack([np.stack([x - gap / 2, y], -1), np.stack([x + gap / 2, y], -1)], 1)
    return tips, np.gradient(tips, CONTROL_PERIOD, axis=0)


def stack(rig: Rig, friction: float, overtravel: float) -> Placed:
    """Block 2 set on block 1 by fingers that feel the touch and go `overtravel` [m] beyond it."""
    blocks = {name: replace(block, friction=friction) for name, block in PAPER_BLOCKS.items()}
    scene = physics(rig, [blocks[name] for name in STACK.objects])
    t = np.arange(0.0, DURATION, CONTROL_PERIOD)
    held = t < LOWER + 0.5
    target = blocks["block1"].height + blocks["block2"].height / 2
    for _ in range(PASSES):
        tips, velocity = finger_path(target - overtravel + LIGHT, t)
        motion = rollout(scene, standing(scene, STACK, PLACES), jnp.asarray(tips), jnp.asarray(velocity),
                         CONTROL_PERIOD, substeps_for(scene, CONTROL_PERIOD))  # fmt: skip
        slid = _slid(rig, tips, motion)
        landed = (np.asarray(motion.support)[:, 1] > 0) & (t > TRAVEL) & held
        touch = np.argmax(landed) if landed.any() else np.flatnonzero(held)[-1]
        target = blocks["block1"].height + blocks["block2"].height / 2 + slid[touch]
    return _measured(rig, friction, t, tips, velocity, motion, slid)


def _slid(rig: Rig, tips: np.ndarray, motion: Record) -> np.ndarray:
    """How far block 2 has slid down between the fingers (T,) [m], the pads' shear taken out."""
    over = tips[:, :, 1].mean(axis=1) - np.asarray(motion.blocks)[:, 1, 1]
    return over - np.asarray(motion.force)[:, :, 1].mean(axis=1) / rig.fingertip.shear_stiffness


def _measured(rig: Rig, friction: float, t: np.ndarray, tips: np.ndarray, velocity: np.ndarray,
              motion: Record, slid: np.ndarray) -> Placed:  # fmt: skip
    """What the paper's method makes of the noiseless record of it."""
    rate = rig.rate or 20.0
    k = np.arange(0, t.size, round(1 / rate / CONTROL_PERIOD))
    trial = record(t[k], tips[k], velocity[k], np.asarray(motion.force)[k], rig, None, "stacked")
    signals = task_space(trial, rig)
    found = segment_qualitative(trial, signals, STACK)
    height = estimate_plugin([signals], [found], STACK)[0]["block1"]["height"]
    residual = height["mean"] - PAPER_BLOCKS["block1"].height if height is not None else np.nan
    spans = {span.subtask: span for span in found.spans}
    ends = [_mean(t, slid, spans[name]) for name in ("pickup", "place")] if found.complete else [np.nan] * 2
    return Placed(friction, ends[1] - ends[0], residual, t[k], slid[k], tips[k, 1, 1])


def _mean(t: np.ndarray, values: np.ndarray, span) -> float:
    return float(values[(t >= span.start + MARGIN) & (t < span.end - MARGIN)].mean())


def performed(case: Case) -> list[dict]:
    """Whole virtual trials with less and less friction: slip and residual of both heights [m].

    Slip counts towards the estimate: down for the height of block 1, up for that of block 2.
    """
    rows = []
    for friction in PERFORMED:
        blocks = {name: replace(block, friction=friction) for name, block in PAPER_BLOCKS.items()}
        for one in simulate_trials(case.task, case.rig, [blocks] * 10, list(range(10))):
            signals = task_space(one.trial, case.rig)
            found = segment_qualitative(one.trial, signals, case.task)
            properties, _ = estimate_plugin([signals], [found], case.task)
            for beneath, move, sign in (("block2", 0, -1), ("block1", 1, 1)):
                height, slip = properties[beneath]["height"], _slip(one, case, move)
                if height is not None and np.isfinite(slip):
                    residual = height["mean"] - PAPER_BLOCKS[beneath].height
                    rows.append({"friction": friction, "height_of": beneath, "slip": sign * slip,
                                 "residual": residual})  # fmt: skip
    return rows


def _slip(one: SimulatedTrial, case: Case, move: int) -> float:
    """How far a move's block slid down between the fingers from pickup to place [m]; NaN if dropped."""
    touch, leave, meet, part = one.boundaries[4 * move : 4 * move + 4]
    block = case.task.objects.index(case.task.performed[move].object)
    over = one.motion.position[:, :, 1].mean(axis=1) - one.motion.blocks[:, block, 1]
    slid = over - one.motion.force[:, :, 1].mean(axis=1) / case.rig.fingertip.shear_stiffness
    pickup, place = ((one.t > a + MARGIN) & (one.t < b - MARGIN) for a, b in ((touch, leave), (meet, part)))
    return float(slid[place].mean() - slid[pickup].mean()) if pickup.any() and place.any() else np.nan


def heights(case: Case) -> dict:
    """Residuals [m] of the paper's heights in recordings, pads rigid and pads taken out, per block."""
    out: dict = {}
    for name in BLOCKS:
        out[name] = {}
        for pads, compliant in (("rigid", False), ("compliant", True)):
            found = [by_formula(case, i, compliant)[name]["height"] for i in range(len(case.trials))]
            residual = np.array([f["mean"] for f in found if f is not None]) - case.blocks[name]["height"][0]
            out[name][pads] = {"mean": residual.mean(), "rms": np.sqrt(np.mean(residual**2)),
                               "each": residual}  # fmt: skip
    return out


def bounds(case: Case, needed: float) -> dict:
    """Evidence from friction against slip: grips [N] below which block 2 could slide by the paper's bound."""
    mu, weight = PRINTED["block2"]["friction"], case.blocks["block2"]["weight"][0]
    return {"needed_friction": needed, "paper_bound": mu, "grip": GRIP, "impact": IMPACT,
            "grip_by_weight": weight / (2 * mu), "grip_by_impact": IMPACT / (2 * mu)}  # fmt: skip


def seen(case: Case) -> dict[str, float]:
    """Probability that `identify` gives to slip in the grip of each block."""
    found = identify(case.trials, case.task, case.rig)
    evidence = {name: found.friction[name].slip for name in BLOCKS}
    return {name: np.nan if e is None else e.probability for name, e in evidence.items()}


def main() -> None:
    """Save both scans, virtual trials, and the heights of a healthy and a slipping recording."""
    case = recorded()
    weight = PAPER_BLOCKS["block2"].weight
    lifted = [stack(case.rig, ratio * weight / (2 * GRIP), LIGHT) for ratio in HOLDING]
    landed = [stack(case.rig, 1.6 * weight / (2 * GRIP), depth) for depth in OVERTRAVEL]
    long = PRINTED["block1"]["height"][0] - case.blocks["block1"]["height"][0]
    order = np.argsort([p.residual for p in lifted])
    needed = float(np.interp(long, [lifted[i].residual for i in order], [lifted[i].friction for i in order]))
    example = stack(case.rig, needed, LIGHT)
    save("slip", {
        "long": long, "long_of_block2": PRINTED["block2"]["height"][0] - case.blocks["block2"]["height"][0],
        "lifting": [{"holding": r, "friction": p.friction, "slip": p.slip, "residual": p.residual}
                    for r, p in zip(HOLDING, lifted, strict=True)],
        "touching": [{"overtravel": d, "slip": p.slip, "residual": p.residual}
                     for d, p in zip(OVERTRAVEL, landed, strict=True)],
        "example": {"friction": needed, "slip": example.slip, "residual": example.residual,
                    "t": example.t, "slid": example.sliding, "height": example.height},
        "performed": performed(case), "paper_blocks": heights(case),
        "grip_slip_1": heights(recorded("grip_slip_1")),
        "seen": {name: seen(recorded(name)) for name in ("paper_blocks", "grip_slip_1")},
        "bounds": bounds(case, needed),
    })  # fmt: skip


if __name__ == "__main__":
    main()
