"""Worlds: circumstances of healthy recordings, drawn as labs differ.

Rates, paces, pads, sensors (better, worse and coloured otherwise than stated), operators, servos, feet of
blocks, pads that turn, fingers that close one after the other, small errors within what the rig states
under [systematic], rates by the drive's own differences, tasks. What a bracket is called in the tables
stands here too.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from experiments.blind_check.hand import Rig
from experiments.blind_check.operator import Style
from experiments.blind_check.scene import FEET, TASKS, Task, World
from experiments.blind_check.signals import Sampling

RATES = (20.0, 20.0, 20.0, 50.0, 50.0, 100.0, 100.0, 200.0, 500.0)  # Hz, as often as listed
# What a rig that states anything states, as standard deviations (shares but for N and rad).
STATED = {"force_bias": 0.003, "force_gain": 0.003, "joint_offset": 0.0003, "link_length": 0.0005,
          "pad_stiffness": 0.02}  # fmt: skip


@dataclass(frozen=True)
class Circumstances:
    """One lab. Stated: `rate` [Hz], pads [N/m], noise as multiples of the nominal rig's (`sensors`),
    `systematic`. Unstated: `pace`, true noise over stated (`noise`), its `colour`, `profile`, `stagger` [s],
    `feet`, `pad_turning` [N m/rad], `servo` [N/m], `differences`, `mirrored`, and the `errors` that are
    within the systematic ones.
    """

    task: str = "reversal"
    rate: float = 20.0
    normal_stiffness: float = 4000.0
    shear_stiffness: float = 2500.0
    sensors: float = 1.0
    systematic: dict[str, float] = field(default_factory=dict)
    errors: dict[str, list[float]] = field(default_factory=dict)
    pace: float = 1.0
    noise: tuple[float, float, float] = (1.0, 1.0, 1.0)
    colour: float = 0.0
    profile: str = "minimum_jerk"
    stagger: float = 0.0
    feet: str = "box"
    pad_turning: float = 2.0
    servo: float = 800.0
    differences: bool = False
    mirrored: bool = False

    def rig(self, nominal: Rig) -> Rig:
        """The rig as stated."""
        return replace(
            nominal, rate=self.rate, normal_stiffness=self.normal_stiffness,
            shear_stiffness=self.shear_stiffness, angle_noise=nominal.angle_noise * self.sensors,
            velocity_noise=self.velocity_noise(nominal), force_noise=nominal.force_noise * self.sensors,
        )  # fmt: skip

    def velocity_noise(self, nominal: Rig) -> float:
        """Stated noise of rates [rad/s]; for differences, the one propagated from the angles."""
        if self.differences:
            return float(np.sqrt(2) * nominal.angle_noise * self.sensors * self.rate)
        return nominal.velocity_noise * self.sensors

    def world(self) -> World:
        """The true pads and blocks."""
        return World(
            self.normal_stiffness, self.shear_stiffness,
            uneven=tuple(self.errors.get("pad_stiffness", (0.0, 0.0))),  # type: ignore[arg-type]
            pad_turning=self.pad_turning, feet=self.feet,
        )  # fmt: skip

    def style(self) -> Style:
        """The operator's style."""
        p, s = self.pace, self.servo
        return Style(
            pace=(0.93 * p, 1.08 * p), stagger=(0.5 * self.stagger, self.stagger), profile=self.profile,
            stiffness=(0.85 * s, 1.15 * s), mirrored=self.mirrored,
        )  # fmt: skip

    def sampling(self) -> Sampling:
        """The sampling."""
        return Sampling(noise=self.noise, colour=self.colour, differences=self.differences)

    @property
    def work(self) -> Task:
        """The task."""
        return TASKS[self.task]

    def brackets(self) -> dict[str, str]:
        """The bracket of every circumstance, by the names of the tables."""
        mean = float(np.mean(self.noise))
        return {
            "task": self.task,
            "rate": "20 Hz" if self.rate <= 20 else "50-100 Hz" if self.rate <= 100 else "200-500 Hz",
            "pace": _third(self.pace, 0.8, 1.25),
            "pads": _third(self.normal_stiffness, 3000, 5500),
            "sensors": _third(self.sensors, 0.75, 1.3),
            "true noise": _third(mean, 0.95, 1.1),
            "operator": self.profile,
            "fingers": "apart" if self.stagger > 0.02 else "together",
            "pads turn": "easily" if self.pad_turning < 0.4 else "hardly",
            "rates": "differences" if self.differences else "measured",
            "systematic": "stated" if self.systematic else "none",
        }


def _third(value: float, low: float, high: float) -> str:
    return f"< {low:g}" if value < low else f"> {high:g}" if value > high else f"{low:g}-{high:g}"


def draw_world(rng: np.random.Generator, fastest: float = float("inf")) -> Circumstances:
    """Draw a lab: most circumstances differ a little, some a lot; rates are at most `fastest` [Hz]."""
    u = rng.uniform
    pads = _log(rng, 2000, 8000)
    common = u(0.8, 1.3)
    noise = tuple(float(np.clip(common * u(0.93, 1.07), 0.8, 1.3)) for _ in range(3))
    systematic = {k: v * _log(rng, 0.5, 2.0) for k, v in STATED.items()} if rng.random() < 0.35 else {}
    return Circumstances(
        task=str(rng.choice(["reversal"] * 6 + [t for t in TASKS if t != "reversal"])),
        rate=float(rng.choice([r for r in RATES if r <= fastest])), normal_stiffness=round(pads, -1),
        shear_stiffness=round(pads * u(0.45, 0.8), -1), sensors=_log(rng, 0.5, 2.0),
        systematic=systematic, errors=_errors(systematic, rng), pace=_log(rng, 0.5, 2.0),
        noise=noise, colour=float(rng.choice([0.0, u(0, 0.3)])),
        profile=str(rng.choice(["minimum_jerk", "trapezoid", "person"])),
        stagger=float(rng.choice([0.0, u(0.0, 0.1)])), feet=str(rng.choice(list(FEET))),
        pad_turning=_log(rng, 0.05, 5.0), servo=_log(rng, 400, 1600),
        differences=bool(rng.random() < 0.2), mirrored=bool(rng.random() < 0.3),
    )  # fmt: skip


def world_of(label: dict) -> Circumstances:
    """The world described by a label."""
    table = label["world"]
    return Circumstances(**table | {"noise": tuple(table["noise"])})


def _errors(systematic: dict[str, float], rng: np.random.Generator) -> dict[str, list[float]]:
    """Errors drawn from the stated standard deviations: per channel, joint, link or finger."""
    size = {"pad_stiffness": 2}
    return {k: [float(v) for v in sd * rng.standard_normal(size.get(k, 4))] for k, sd in systematic.items()}


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
