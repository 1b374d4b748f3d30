"""The labs of the calibrations: the usual hand and task, and the ways in which recordings differ.

`World` says how a lab differs (rate, pace, noise, ringing contacts, lost values, towers, pads, errors that
its rig states or does not, hands that are not tidy), and `replicates` records trials there, with their truth;
`simulated_cases` gives healthy cases as a folder of recordings would, with hands that deviate from their rig
as a [systematic] table says. Trials are the virtual model's own. A number gives the same blocks and the same
draw of the operator in every world, so that worlds differ by their condition alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from experiments.recordings import Case
from hmmseg.hand.kinematics import inverse, joint_velocity
from hmmseg.hand.signals import task_space
from hmmseg.io.rig import FORCE_CHANNELS, JOINTS, Fingertip, Noise, Rig, Systematic, read_rig
from hmmseg.io.task import BlockTask, parse_task, read_task
from hmmseg.io.trial import Trial
from simgap.gap.simulated import recorded
from simgap.world.dynamics import CONTROL_PERIOD
from simgap.world.operator import OperatorSettings, Plan, Window, minimum_jerk
from simgap.world.properties import Block
from simgap.world.simulate import SimulatedTrial, simulate_trials

SCENE = Path(__file__).parent / "scene"
SHEAR_SHARE = 0.625  # shear over normal stiffness of the usual pads
BIAS = 0.02  # N; standard deviation under [systematic] in worlds with biases
PADS = 0.3  # share, likewise of pads
HAND = Systematic(force_bias=(0.01,) * 4, force_gain=(0.01,) * 4, joint_offset=(0.001,) * 4,
                  link_length=(0.001,) * 4, pad_stiffness=(0.1, 0.1))  # fmt: skip
RINGING = (15.0, 35.0)  # Hz, a fingertip on its arm; drawn once a trial
DAMPING = 0.05  # ratio to critical
GRASP_SPREAD = 0.0005  # m; the operator's own scatter of the grip's height over the block's centre


def scene(rate: float | None = None) -> tuple[Rig, BlockTask]:
    """The usual hand and task: two stacked blocks are reversed, as in the paper."""
    rig, task = read_rig(SCENE / "rig.toml"), read_task(SCENE / "task.toml")
    assert isinstance(task, BlockTask)
    return (rig if rate is None else rig.model_copy(update={"rate": rate})), task


def task_of(blocks: int) -> BlockTask:
    """The task of reversing a tower of `blocks`; a single block is moved on the ground."""
    if blocks == 2:
        return scene()[1]
    names = [f"b{k}" for k in range(blocks)]
    under = {name: on for name, on in zip(names, [*names[1:], "ground"], strict=True)}
    moves = [{"object": name, "to": "ground" if k == 0 else names[k - 1]} for k, name in enumerate(names)]
    task = parse_task({"objects": {n: {"on": on} for n, on in under.items()}, "moves": moves})
    assert isinstance(task, BlockTask)
    return task


def random_properties(task: BlockTask, seed: int) -> dict[str, Block]:
    """Draw blocks for every object of a task from what two fingers can handle.

    Uniform: weights 0.25-0.65 N, widths 14-29 mm, heights 12-19 mm, friction 1.0-1.4.
    """
    rng = np.random.default_rng([seed, 1])
    return {name: Block(rng.uniform(0.25, 0.65), rng.uniform(0.014, 0.029), rng.uniform(0.012, 0.019),
                        rng.uniform(1.0, 1.4)) for name in task.objects}  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """One condition of sensors and work.

    `noise` and `pace` (rate of work) in units of the usual ones; `rate` [Hz]; `vibration` [N], its
    amplitude at a contact change; `missing`, the share of the recording's values that are lost.
    """

    noise: float = 1.0
    rate: float = 20.0
    pace: float = 1.0
    vibration: float = 0.0
    missing: float = 0.0


@dataclass(frozen=True)
class World:
    """One lab: a tower of `blocks` reversed (one: moved), `trials` pooled.

    `pads` [N/m]; `stated`: noise as the rig has it, over what it is; `coloured`: lag-one correlation of
    the noise; `bias`: of every force, in units of what [systematic] admits (BIAS); `softer`: pads' true
    stiffness over the rig's, which admits PADS in [systematic] if `doubted`; `deviating`: a hand drawn
    from the [systematic] table HAND. `effects` act on the recording without a word in the rig; `untidy`
    names one of UNTIDY.
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
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    untidy: str | None = None


def _worlds() -> list[World]:
    out = [World("as usual")]
    out += [World(f"{r:g} Hz", Cell(rate=r)) for r in (10.0, 50.0, 200.0, 2000.0)]
    out += [World(f"pace {p:g}", Cell(pace=p)) for p in (0.5, 3.0)]
    out += [World(f"noise x{n:g}", Cell(noise=n)) for n in (0.25, 4.0, 16.0)]
    out += [World(f"ringing {v:g} N", Cell(vibration=v)) for v in (0.3, 1.0)]
    out += [World(f"pads {k:g} N/m", pads=k) for k in (1500.0, 12000.0)]
    out += [World("missing 40 %", Cell(missing=0.4))]
    out += [World(f"noise stated x{s:g}", stated=s) for s in (0.5, 2.0)]
    out += [World("noise AR(1) 0.5", coloured=0.5)]
    out += [World("bias as admitted", bias=1.0), World("bias twice that", bias=2.0)]
    out += [
        World("pads 30 % off, admitted", softer=0.7, doubted=True),
        World("pads 30 % off, untold", softer=0.7),
    ]
    out += [World("low-pass 30 ms, untold", effects={"force_lowpass": {"time_constant": 0.03}})]
    out += [World("hand as [systematic]", deviating=True)]
    out += [World("1 block", blocks=1), World("3 blocks", blocks=3), World("6 blocks", blocks=6)]
    out += [World("4 trials", trials=4), World("20 trials", trials=20)]
    return out


WORLDS = {world.name: world for world in _worlds()}


@dataclass(frozen=True)
class Replicate:
    """Trials as the estimator gets them, with the truth."""

    task: BlockTask
    rig: Rig
    trials: list[Trial]
    boundaries: list[np.ndarray]
    blocks: dict[str, Block]


@dataclass(frozen=True)
class Judged:
    """A single trial as the estimator gets it, with its true boundaries [s]."""

    trial: Trial
    rig: Rig
    boundaries: np.ndarray


def replicates(world: World, numbers: Sequence[int]) -> Iterator[Replicate]:
    """Replicates of a world by number, each independent of the others drawn with it."""
    task, sensors = task_of(world.blocks), sensors_of(world)
    seeds = [100 * number + k for number in numbers for k in range(world.trials)]
    done = iter(_happens(world, [n for n in numbers for _ in range(world.trials)], seeds))
    for number in numbers:
        mine = [next(done) for _ in range(world.trials)]
        trials = [_recorded(world, s, task, sensors, number) for s in mine]
        yield Replicate(task, _stated(world, sensors), trials, [s.boundaries for s in mine],
                        dict(mine[0].blocks))  # fmt: skip


def trials_of(world: World, numbers: Sequence[int]) -> list[Judged]:
    """Single trials of a world by number, which also seeds the operator."""
    task, sensors = task_of(world.blocks), sensors_of(world)
    return [
        Judged(_recorded(world, s, task, sensors, number), _stated(world, sensors), s.boundaries)
        for number, s in zip(numbers, _happens(world, numbers, numbers), strict=True)
    ]


def sensors_of(world: World) -> Rig:
    """The recording hand: the world's pads as stated, its rate and true noise."""
    pads = Fingertip(normal_stiffness=world.pads, shear_stiffness=SHEAR_SHARE * world.pads)
    rig = scene()[0]
    noise = {name: sd * world.cell.noise for name, sd in rig.noise.model_dump(exclude_none=True).items()}
    return rig.model_copy(update={"fingertip": pads, "rate": world.cell.rate, "noise": Noise(**noise)})


def _happens(world: World, numbers: Sequence[int], seeds: Sequence[int]) -> list[SimulatedTrial]:
    """The true trials, one per pair; worlds that differ only in their sensors share them."""
    stiffness = world.pads * world.softer
    true = {"normal_stiffness": stiffness, "shear_stiffness": SHEAR_SHARE * stiffness}
    true |= world.effects.get("fingertip_compliance", {})
    return _performed(
        world.cell.pace, *true.values(), world.blocks, world.untidy, tuple(numbers), tuple(seeds)
    )


@lru_cache(maxsize=4)
def _performed(pace: float, normal: float, shear: float, blocks: int, untidy: str | None,
               numbers: tuple[int, ...], seeds: tuple[int, ...]) -> list[SimulatedTrial]:  # fmt: skip
    pads = Fingertip(normal_stiffness=normal, shear_stiffness=shear)
    rig, task = scene()[0].model_copy(update={"fingertip": pads}), task_of(blocks)
    operator = OperatorSettings(pace=(pace, pace), grasp=(-GRASP_SPREAD, GRASP_SPREAD))
    drawn = {number: random_properties(task, number) for number in numbers}
    return simulate_trials(task, rig, [drawn[n] for n in numbers], list(seeds), operator,
                           alter=UNTIDY.get(untidy or ""))  # fmt: skip


def _recorded(world: World, simulated: SimulatedTrial, task: BlockTask, rig: Rig, number: int) -> Trial:
    t = np.arange(int(simulated.t[-1] * world.cell.rate)) / world.cell.rate
    resampled = replace(simulated, trial=replace(simulated.trial, t=t))
    trial = recorded(resampled, task, rig, world.effects)
    if world.coloured:
        quiet = {name: sd * 1e-9 for name, sd in rig.noise.model_dump(exclude_none=True).items()}
        clean = recorded(resampled, task, rig.model_copy(update={"noise": Noise(**quiet)}), {})
        trial = _coloured(trial, clean, world.coloured)
    trial = disturbed(trial, simulated.boundaries, world.cell, simulated.seed)
    rng = np.random.default_rng([number, 6])  # one hand for all trials of a replicate
    if world.bias:
        signs = world.bias * BIAS * rng.choice([-1.0, 1.0], 4)
        shifted = {n: trial.channels[n] + b for n, b in zip(FORCE_CHANNELS, signs, strict=True)}
        trial = replace(trial, channels=trial.channels | shifted)
    return deviated(trial, rig, draw_deviations(HAND, rng)) if world.deviating else trial


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


def _stated(world: World, sensors: Rig) -> Rig:
    """The rig as the estimator gets it."""
    noise = {name: sd * world.stated for name, sd in sensors.noise.model_dump(exclude_none=True).items()}
    stated = sensors.model_copy(update={"noise": Noise(**noise)})
    if world.bias:
        stated = stated.model_copy(update={"systematic": Systematic(force_bias=(BIAS,) * 4)})
    if world.doubted:
        stated = stated.model_copy(update={"systematic": Systematic(pad_stiffness=(PADS, PADS))})
    return stated.model_copy(update={"systematic": HAND}) if world.deviating else stated


def disturbed(trial: Trial, boundaries: np.ndarray, cell: Cell, number: int) -> Trial:
    """The trial with ringing contacts and lost values, as its cell has them."""
    channels = dict(trial.channels)
    if cell.vibration > 0:
        rng = np.random.default_rng([number, 3])
        frequency = rng.uniform(*RINGING)
        for name in FORCE_CHANNELS:
            signs = rng.choice([-1.0, 1.0], boundaries.size)
            channels[name] = channels[name] + cell.vibration * ringing(trial.t, boundaries, frequency, signs)
    if cell.missing > 0:
        rng = np.random.default_rng([number, 4])
        for name, values in channels.items():
            channels[name] = np.where(rng.random(values.size) < cell.missing, np.nan, values)
    return replace(trial, channels=channels)


def ringing(t: np.ndarray, at: np.ndarray, frequency: float, signs: np.ndarray) -> np.ndarray:
    """Sum of unit impulse responses exp(-z w s) sin(w s) of a lightly damped mode, one from each time."""
    omega = 2 * np.pi * frequency
    since = t[:, None] - at[np.isfinite(at)]
    wave = np.exp(-DAMPING * omega * np.maximum(since, 0)) * np.sin(omega * since)
    return np.where(since > 0, wave, 0.0) @ signs[np.isfinite(at)]


# Hands that are not tidy: each alters the commanded motion, so that the simulator's own mechanics makes the
# forces.
Alter = Callable[[Plan, np.random.Generator], Plan]
LATE = (0.02, 0.1)  # s by which one finger closes after the other
LOOSENED = 0.06  # s for which a grip opens amid a carry, by ...
SLACK = 0.42  # ... this share of its way: it is lost for 40 ms; from about 0.46 on blocks are dropped


def _row(t: float) -> int:
    return round(t / CONTROL_PERIOD)


def _pulse(n: int) -> np.ndarray:
    """A pulse (n,) from 0 to 1 and back by minimum-jerk motions."""
    phase = np.linspace(0.0, 1.0, n)
    return minimum_jerk(2 * phase) - minimum_jerk(2 * phase - 1)


def _inserted(plan: Plan, at: float, change: np.ndarray) -> Plan:
    """The plan with a pause at `at` [s], during which `change` (n, 4) [m] is added to the command."""
    k, longer = _row(at), len(change) * CONTROL_PERIOD
    command = np.concatenate([plan.command[:k], plan.command[k] + change, plan.command[k:]])

    def later(w: Window) -> Window:
        times = {f: getattr(w, f) for f in ("close", "lift", "middle", "open", "end")}
        return replace(w, **{f: v + longer * (v >= at) for f, v in times.items()})

    windows = tuple(later(w) for w in plan.windows)
    return replace(plan, command=command, windows=windows, duration=plan.duration + longer)


def late_finger(plan: Plan, rng: np.random.Generator) -> Plan:
    """One finger closes up to 0.1 s after the other, at every grip."""
    command = plan.command.copy()
    for w in plan.windows:
        late, column = _row(rng.uniform(*LATE)), rng.choice([0, 2])
        start, stop = _row(w.close), _row(w.lift)
        command[start + late : stop, column] = plan.command[start : stop - late, column]
        command[start : start + late, column] = plan.command[start, column]
    return replace(plan, command=command)


def tapping(plan: Plan, rng: np.random.Generator) -> Plan:
    """The fingers touch each block briefly before they grip it."""
    for k in range(len(plan.windows)):
        w = plan.windows[k]
        row, after = plan.command[_row(w.close)], plan.command[_row(w.lift) - 1]
        grip = (after[2] - after[0]) - (row[2] - row[0])  # to the commanded squeeze, negative
        n = _row(rng.uniform(0.35, 0.5))
        way = -grip / 2 * rng.uniform(0.62, 0.75)
        change = np.zeros((n, 4))
        change[:, 0], change[:, 2] = way * _pulse(n), -way * _pulse(n)
        plan = _inserted(plan, w.close, np.concatenate([change, np.zeros((150, 4))]))
    return plan


def slipping(plan: Plan, rng: np.random.Generator) -> Plan:
    """The grip loosens briefly in mid-carry; the block slips a little and is held again."""
    for k in range(len(plan.windows)):
        w = plan.windows[k]
        open_, held = plan.command[_row(w.close)], plan.command[_row(w.lift) - 1]
        way = ((open_[2] - open_[0]) - (held[2] - held[0])) / 2
        n = _row(LOOSENED)
        change = np.zeros((2 * n, 4))
        loosen = SLACK * way * np.pad(_pulse(n), (0, n))
        change[:, 0], change[:, 2] = -loosen, loosen
        plan = _inserted(plan, w.middle, change)
    return plan


UNTIDY: dict[str, Alter] = {"late finger": late_finger, "tapping": tapping, "slipping": slipping}


SEED = 40_000  # cases are SEED, SEED + 1, ...; their trials 100 times that and on


@dataclass(frozen=True)
class Deviations:
    """How the true hand differs from the nominal one, units as in `hmmseg.io.rig.Systematic`."""

    force_bias: np.ndarray
    force_gain: np.ndarray
    joint_offset: np.ndarray
    link_length: np.ndarray
    pad_stiffness: np.ndarray


def draw_deviations(systematic: Systematic, rng: np.random.Generator) -> Deviations:
    """Draw a hand, every deviation normal with its standard deviation from the table."""
    names = Deviations.__dataclass_fields__
    return Deviations(**{n: rng.normal(0.0, np.asarray(getattr(systematic, n))) for n in names})


def simulated_cases(num: int, trials: int = 4, seed: int = SEED, systematic: Systematic | None = None,
                    rate: float | None = None) -> list[Case]:  # fmt: skip
    """`num` cases of `trials` trials each, each reproducible from its own seed."""
    rig, task = scene(rate)
    blocks = [random_properties(task, seed + i) for i in range(num)]
    seeds = [100 * (seed + i) + k for i in range(num) for k in range(trials)]
    simulated = simulate_trials(task, rig, [b for b in blocks for _ in range(trials)], seeds)
    stated = rig if systematic is None else rig.model_copy(update={"systematic": systematic})
    cases = []
    for i in range(num):
        mine = simulated[i * trials : (i + 1) * trials]
        recorded = [replace(s.trial, file=f"trial_{k:02d}.csv") for k, s in enumerate(mine, 1)]
        if systematic is not None:
            hand = draw_deviations(systematic, np.random.default_rng([seed + i, 5]))
            recorded = [deviated(trial, rig, hand) for trial in recorded]
        true = {name: {p: (getattr(b, p), 0.0) for p in ("weight", "width", "height", "friction")}
                for name, b in blocks[i].items()}  # fmt: skip
        cases.append(Case(
            f"case_{seed + i}", stated, task, tuple(recorded),
            tuple(task_space(trial, stated) for trial in recorded),
            tuple(tuple(s.boundaries) for s in mine), true, ("none",),
        ))  # fmt: skip
    return cases


def deviated(trial: Trial, rig: Rig, hand: Deviations) -> Trial:
    """What a deviating hand records of the same motions and forces.

    Pads of another stiffness put the tips elsewhere for the same forces; other links and joint
    zeros give other angles for the same tips; forces are read with gain and bias.
    """
    signals, channels = task_space(trial, rig), dict(trial.channels)
    for i in (1, 2):
        give = 1 / (1 + hand.pad_stiffness[i - 1]) - 1
        x, y, vx, vy, fx, fy = (getattr(signals, f"{n}{i}") for n in ("x", "y", "vx", "vy", "fx", "fy"))
        pad = rig.fingertip
        tip = np.stack([x + fx / pad.normal_stiffness * give, y + fy / pad.shear_stiffness * give], axis=1)
        speed = np.stack([vx, vy], axis=1)
        nominal_finger = rig.finger(i)
        first, second = np.asarray(nominal_finger.links) * (1 + hand.link_length[2 * i - 2 : 2 * i])
        finger = nominal_finger.model_copy(update={"links": (float(first), float(second))})
        angles = inverse(finger, i, tip)
        rates = joint_velocity(finger, angles, speed)
        for k in (0, 1):
            channels[f"q{i}{k + 1}"] = angles[:, k] + hand.joint_offset[JOINTS.index(f"q{i}{k + 1}")]
            channels[f"dq{i}{k + 1}"] = rates[:, k]
    for k, name in enumerate(FORCE_CHANNELS):
        channels[name] = (1 + hand.force_gain[k]) * channels[name] + hand.force_bias[k]
    return replace(trial, channels=channels)
