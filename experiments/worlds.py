"""The labs of the calibrations: the usual hand and task, and how what is recorded there may differ.

`Cell` says how a recording differs (rate, pace, noise, ringing contacts, lost values), `World` adds pads,
effects that the rig does not state, and hands that are not tidy; `simulated_cases` gives healthy cases as a
folder of recordings would, with hands that deviate from their rig as a [systematic] table says. Trials are
the virtual model's own. A number gives the same blocks and the same draw of the operator in every world, so
that worlds differ by their condition alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from experiments.recordings import Case
from hmmseg.hand.kinematics import inverse, joint_velocity
from hmmseg.hand.signals import Signals, task_space
from hmmseg.io.rig import FORCE_CHANNELS, JOINTS, Fingertip, Noise, Rig, Systematic, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.io.trial import Trial
from simgap.gap.twins import recorded
from simgap.world.dynamics import CONTROL_PERIOD
from simgap.world.operator import OperatorSettings, Plan, Window, minimum_jerk
from simgap.world.properties import random_properties
from simgap.world.simulate import SimulatedTrial, simulate_trials

SCENE = Path(__file__).parent / "scene"


def scene(rate: float | None = None) -> tuple[Rig, BlockTask]:
    """The usual hand and task: two stacked blocks are reversed, as in the paper."""
    rig, task = read_rig(SCENE / "rig.toml"), read_task(SCENE / "task.toml")
    assert isinstance(task, BlockTask)
    return (rig if rate is None else rig.model_copy(update={"rate": rate})), task


@dataclass(frozen=True)
class Cell:
    """One condition.

    `noise` and `pace` (rate of work) in units of the usual ones; `rate` [Hz]; `vibration` [N], its
    amplitude at a contact change; `missing`, the share of the recording's values that are lost;
    `grasp` [m], height of the grip over the block's centre; `stated`: the rig states its noise.
    """

    noise: float = 1.0
    rate: float = 20.0
    pace: float = 1.0
    vibration: float = 0.0
    missing: float = 0.0
    grasp: float = 0.0
    stated: bool = True

    @property
    def key(self) -> str:
        """What differs from the usual, as `noise=4`; `nominal` where nothing does."""
        usual = Cell()
        changed = [(f.name, getattr(self, f.name)) for f in fields(self)
                   if getattr(self, f.name) != getattr(usual, f.name)]  # fmt: skip
        return "_".join(f"{name}={value:g}" for name, value in changed) or "nominal"


FORCES = ("fx1", "fy1", "fx2", "fy2")
RINGING = (15.0, 35.0)  # Hz, a fingertip on its arm; drawn once a trial
DAMPING = 0.05  # ratio to critical
GRASP_SPREAD = 0.0005  # m; the operator's own scatter about the cell's grip height


def recording_rig(cell: Cell, rig: Rig) -> Rig:
    """The hand that records: the cell's rate and true noise."""
    scaled = {name: sd * cell.noise for name, sd in rig.noise.model_dump(exclude_none=True).items()}
    return rig.model_copy(update={"rate": cell.rate, "noise": Noise(**scaled)})


def disturbed(trial: Trial, boundaries: np.ndarray, cell: Cell, number: int) -> Trial:
    """The trial with ringing contacts and lost values, as its cell has them."""
    channels = dict(trial.channels)
    if cell.vibration > 0:
        rng = np.random.default_rng([number, 3])
        frequency = rng.uniform(*RINGING)
        for name in FORCES:
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
# forces; `turned` alone edits the recording, as the simulator's blocks keep their orientation.
Alter = Callable[[Plan, np.random.Generator], Plan]
LATE = (0.02, 0.1)  # s by which one finger closes after the other
PUSH = 1.5e-3  # m that a push on the ground commands
STILL = 10.0  # s of holding a block still in the air
SLOWEST = 0.05  # of the usual pace, amid a hesitation
LOOSENED = 0.06  # s for which a grip opens amid a carry, by ...
SLACK = 0.42  # ... this share of its way: it is lost for 40 ms; from about 0.46 on blocks are dropped


def _row(t: float) -> int:
    return round(t / CONTROL_PERIOD)


def _pulse(n: int) -> np.ndarray:
    """There and back (n,) by minimum-jerk motions."""
    phase = np.linspace(0.0, 1.0, n)
    return minimum_jerk(2 * phase) - minimum_jerk(2 * phase - 1)


def _inserted(plan: Plan, at: float, change: np.ndarray) -> Plan:
    """The plan with a pause at `at` [s]; `change` (n, 4) [m] is added to what is commanded in it."""
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
    """The fingers touch a block for a moment before they grip it, every time."""
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


def pushed(plan: Plan, rng: np.random.Generator) -> Plan:
    """A gripped block is pushed sideways on the ground before it is lifted."""
    for k in range(len(plan.windows)):
        n, change = _row(0.4), np.zeros((_row(0.4), 4))
        change[:, 0] = change[:, 2] = rng.choice([-PUSH, PUSH]) * _pulse(n)
        plan = _inserted(plan, plan.windows[k].lift - 0.02, change)
    return plan


def still(plan: Plan, rng: np.random.Generator) -> Plan:
    """The first block is held still in the air for ten seconds, but for a tremor."""
    t = np.arange(_row(STILL)) * CONTROL_PERIOD
    change = 4e-5 * np.sin(2 * np.pi * rng.uniform(6, 12, 4) * t[:, None])
    return _inserted(plan, plan.windows[0].middle, change)


def hesitating(plan: Plan, rng: np.random.Generator) -> Plan:
    """The hand nearly stops on its way to a lift, in mid-lift and on its way down, in every move."""
    moments = [m + rng.uniform(-0.05, 0.05) for w in plan.windows
               for m in (w.close - 0.25, w.lift + 0.2, (w.middle + w.open) / 2)]  # fmt: skip
    t = np.arange(len(plan.command)) * CONTROL_PERIOD
    slow = 1 - (1 - SLOWEST) * np.max([np.exp(-(((t - m) / 0.06) ** 2)) for m in moments], axis=0)
    warped = np.concatenate([[0.0], np.cumsum(CONTROL_PERIOD / slow)[:-1]])  # the time now at each row
    fine = np.arange(_row(warped[-1]) + 1) * CONTROL_PERIOD
    command = np.stack([np.interp(fine, warped, c) for c in plan.command.T], axis=1)

    def moved(time: float) -> float:
        return float(np.interp(time, t, warped))

    windows = tuple(
        replace(w, close=moved(w.close), lift=moved(w.lift), middle=moved(w.middle), open=moved(w.open),
                end=moved(w.end)) for w in plan.windows
    )  # fmt: skip
    return replace(plan, command=command, windows=windows, duration=len(fine) * CONTROL_PERIOD)


def slipping(plan: Plan, rng: np.random.Generator) -> Plan:
    """The grip loosens in mid-carry for a moment, the block slips a little and is held again."""
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


UNTIDY: dict[str, Alter] = {
    "late finger": late_finger, "tapping": tapping, "pushed": pushed, "still": still,
    "hesitating": hesitating, "slipping": slipping,
}  # fmt: skip


SHEAR_SHARE = 0.625  # shear over normal stiffness of the usual pads
HOLDING = 0.2  # N
TURN, TURNED = 1.5e-4, 0.05  # m that a turned block spreads the fingers, N of shear that holds it


@dataclass(frozen=True)
class World:
    """One row of the table; `cell` as in the sweeps, `pads` [N/m] told to the estimator as they are.

    `effects` act on the recording without a word in the rig. `untidy` names an alteration.
    """

    name: str
    cell: Cell = field(default_factory=Cell)
    pads: float | None = None
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    untidy: str | None = None


@dataclass(frozen=True)
class Judged:
    """A trial as the estimator gets it, with its true boundaries [s]."""

    trial: Trial
    rig: Rig
    boundaries: np.ndarray


def _worlds() -> list[World]:
    rates = [World(f"{r:g} Hz", Cell(rate=r)) for r in (10.0, 20.0, 50.0, 100.0, 1000.0)]
    paces = [World(f"pace {p:g}", Cell(pace=p)) for p in (0.5, 3.0)]
    noises = [World(f"noise x{n:g}", Cell(noise=n)) for n in (0.25, 4.0, 16.0)]
    rings = [World(f"ringing {v:g} N", Cell(vibration=v)) for v in (0.2, 1.0)]
    pads = [World(f"pads {k:g} N/m", pads=k) for k in (1500.0, 12000.0)]
    effects = {
        "lag 60 ms": {"force_lag": {"delay": 0.06}},
        "low-pass 30 ms": {"force_lowpass": {"time_constant": 0.03}},
        "bias": {"force_bias": {"fx1": 0.08, "fy1": 0.0, "fx2": 0.0, "fy2": -0.06}},
        "pads x0.6": {"fingertip_compliance": {"normal_stiffness": 2400.0, "shear_stiffness": 1500.0}},
        "creep": {"fingertip_creep": {"ratio": 0.4, "time_constant": 0.5}},
    }  # fmt: skip
    told = [World(f"untold: {name}", effects=e) for name, e in effects.items()]
    untidy = [World(name, untidy=name) for name in (*UNTIDY, "turned")]
    fast = [World(f"{name}, 100 Hz", Cell(rate=100.0), untidy=name) for name in ("late finger", "tapping")]
    missing = [World("missing 40 %", Cell(missing=0.4))]
    return [*rates, *paces, *noises, *rings, *pads, *missing, *told, *untidy, *fast]


WORLDS = {world.name: world for world in _worlds()}


def trials_of(world: World, numbers: Sequence[int]) -> list[Judged]:
    """Trials of a world by their numbers."""
    rig = _rig(world)
    stated = recording_rig(world.cell, rig)
    _, task = scene()
    out = []
    for simulated in _performed(world.cell.pace, world.pads, _scene_key(world), world.untidy, tuple(numbers)):
        t = np.arange(int(simulated.t[-1] * world.cell.rate)) / world.cell.rate
        resampled = replace(simulated, trial=replace(simulated.trial, t=t))
        trial = recorded(resampled, task, stated, world.effects)
        trial = disturbed(trial, simulated.boundaries, world.cell, simulated.seed)
        if world.untidy == "turned":
            trial = _turned(trial, simulated.boundaries, stated)
        judged = Judged(trial, stated, simulated.boundaries)
        if world.untidy != "slipping" or _still_held(judged):
            out.append(judged)
    return out


def _still_held(judged: Judged) -> bool:
    """Whether every block is in the grip as it lands: what slips out of it is a drop, and a misfit."""
    lands = judged.boundaries[2::4]
    if not np.isfinite(judged.boundaries).all():
        return False
    signals = task_space(judged.trial, judged.rig)
    return bool((np.interp(lands, signals.t, signals.grip) > HOLDING).all())


def _rig(world: World) -> Rig:
    rig, _ = scene()
    if world.pads is None:
        return rig
    pads = Fingertip(normal_stiffness=world.pads, shear_stiffness=SHEAR_SHARE * world.pads)
    return rig.model_copy(update={"fingertip": pads})


def _scene_key(world: World) -> tuple[float, float] | None:
    values = world.effects.get("fingertip_compliance")
    return None if values is None else (values["normal_stiffness"], values["shear_stiffness"])


@lru_cache(maxsize=4)
def _performed(pace: float, pads: float | None, true_pads: tuple[float, float] | None, untidy: str | None,
               numbers: tuple[int, ...]) -> list[SimulatedTrial]:  # fmt: skip
    """What truly happened; worlds that differ by their sensors alone share it."""
    rig, task = _rig(World("", pads=pads)), scene()[1]
    if true_pads is not None:
        hand = Fingertip(normal_stiffness=true_pads[0], shear_stiffness=true_pads[1])
        rig = rig.model_copy(update={"fingertip": hand})
    operator = OperatorSettings(pace=(pace, pace), grasp=(-GRASP_SPREAD, GRASP_SPREAD))
    blocks = [random_properties(task, number) for number in numbers]
    return simulate_trials(task, rig, blocks, list(numbers), operator, alter=UNTIDY.get(untidy or ""))


def _turned(trial: Trial, boundaries: np.ndarray, rig: Rig) -> Trial:
    """Blocks that turn a little once they leave the ground: faces spread the fingers, shear holds them."""
    channels, rng = dict(trial.channels), np.random.default_rng(len(trial.t))
    for leave, meet in boundaries.reshape(-1, 4)[:, 1:3]:
        up = np.clip((trial.t - leave) / 0.15, 0, 1) * np.clip((meet - trial.t) / 0.05, 0, 1)
        sign = rng.choice([-1.0, 1.0])
        channels["fy1"] = channels["fy1"] + sign * TURNED * up
        channels["fy2"] = channels["fy2"] - sign * TURNED * up
        signals = task_space(replace(trial, channels=channels), rig)
        push = np.clip(signals.grip, 0, None) > 0
        spread = TURN * up * push
        for i, way in ((1, -spread / 2), (2, spread / 2)):
            q, links = (channels[f"q{i}1"], channels[f"q{i}2"]), rig.finger(i).links
            jacobian = np.array([[-links[0] * np.sin(q[0]), -links[1] * np.sin(q[1])],
                                 [links[0] * np.cos(q[0]), links[1] * np.cos(q[1])]])  # fmt: skip
            step = np.linalg.solve(jacobian.transpose(2, 0, 1), np.stack([way, 0 * way], 1)[..., None])[
                ..., 0
            ]
            channels[f"q{i}1"], channels[f"q{i}2"] = q[0] + step[:, 0], q[1] + step[:, 1]
    return replace(trial, channels=channels)


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
    """One hand: every deviation normal with its standard deviation from the table."""
    names = Deviations.__dataclass_fields__
    return Deviations(**{n: rng.normal(0.0, np.asarray(getattr(systematic, n))) for n in names})


def simulated_cases(num: int, trials: int = 4, seed: int = SEED, systematic: Systematic | None = None,
                    rate: float | None = None) -> list[Case]:  # fmt: skip
    """`num` cases of `trials` trials each; reproducible from their seeds, whatever their company."""
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
        tip = np.stack([
            _of(signals, f"x{i}") + _of(signals, f"fx{i}") / rig.fingertip.normal_stiffness * give,
            _of(signals, f"y{i}") + _of(signals, f"fy{i}") / rig.fingertip.shear_stiffness * give,
        ], axis=1)  # fmt: skip
        speed = np.stack([_of(signals, f"vx{i}"), _of(signals, f"vy{i}")], axis=1)
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


def _of(signals: Signals, name: str) -> np.ndarray:
    return getattr(signals, name)
