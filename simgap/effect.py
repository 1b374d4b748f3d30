"""What an effect is, and what its parameters are: the same for blocks, robots, given trials and simulators.

An effect is one mechanism that a model leaves out. What it does forward to a simulation and inversely to a
recording depends on what it acts on: one channel of any table (`simgap.channels`), a hand that moves blocks
(`simgap.effects`), or a robot's logs and its simulator (`simgap.robot_effects`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

Array = Any  # np.ndarray, or a jax.Array under a trace
STATED = ("nominal", "sd", "unit", "low", "high", "effect", "fitted")  # what a simulator says of a parameter
GROSS = 100.0  # prior: times the usual size: a fault so large has been seen on the bench


@dataclass(frozen=True)
class Parameter:
    """One parameter: its prior is normal about `nominal` with `sd`, in `unit`, within `low` and `high`.

    At the nominal value an effect changes nothing. `log`: the prior is of the logarithm, its median nominal
    and `sd` in natural units. `starts` are the values a search starts from. `hidden` parameters are fitted
    but not reported. `shape`: it bends what others amplify and is nothing by itself. `name` is given by the
    effect that has it.

    Of a simulator: parameters of the same `effect` act as one candidate cause; without one, a parameter is
    its own. What is `fitted` was never measured (a friction, say): it is fitted along with every cause and is
    none itself.
    """

    nominal: float
    sd: float
    unit: str = "1"
    low: float = -math.inf
    high: float = math.inf
    effect: str | None = None
    fitted: bool = False
    name: str = ""
    starts: tuple[float, ...] = ()
    log: bool = False
    hidden: bool = False
    shape: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.nominal) and math.isfinite(self.sd) and self.sd > 0):
            raise ValueError(f"nominal {self.nominal} and sd {self.sd}: expected finite, sd above 0")
        if not self.low <= self.nominal <= self.high:
            raise ValueError(f"nominal {self.nominal} lies outside of its bounds {self.low} to {self.high}")

    def value(self, u: Array) -> Array:
        """The parameter from its standard normal coordinate."""
        return self.nominal * np.exp(self.sd * u) if self.log else self.nominal + self.sd * u

    def coordinate(self, value: float) -> float:
        """The inverse of `value`."""
        return float(np.log(value / self.nominal) / self.sd if self.log else (value - self.nominal) / self.sd)

    @property
    def gridded(self) -> bool:
        """Whether a search has to try several start values of it."""
        return bool(self.starts)

    @property
    def limits(self) -> tuple[float, float]:
        """Bounds of the coordinate: five standard deviations of a logarithm, GROSS of others, at most."""
        low = self.coordinate(self.low) if self.low > (0 if self.log else -np.inf) else -np.inf
        high = self.coordinate(self.high) if np.isfinite(self.high) else np.inf
        most = 5.0 if self.log else GROSS
        return max(low, -most), min(high, most)

    def scaled(self, factor: float, unit: str | None = None) -> Parameter:
        """The same of a quantity so much as large, in another unit where one is given."""
        return replace(self, nominal=self.nominal * factor, sd=self.sd * factor, low=self.low * factor,
                       high=self.high * factor, starts=tuple(factor * s for s in self.starts),
                       unit=self.unit if unit is None else unit)  # fmt: skip


@dataclass(frozen=True)
class Effect:
    """One mechanism: what it `says` as an equation, its `parameters` by name, where it `shows`.

    `called`: the effect in plain words, and what to `check` on the hardware.
    """

    name: str
    says: str
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    shows: str = ""
    called: str = ""
    check: str = ""

    def __post_init__(self) -> None:
        named = {n: p if p.name == n else replace(p, name=n) for n, p in self.parameters.items()}
        object.__setattr__(self, "parameters", named)

    def neutral(self) -> dict[str, float]:
        """Values at which nothing is changed (where those exist)."""
        return {n: p.nominal for n, p in self.parameters.items()}
