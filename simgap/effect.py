"""Effects and their parameters: the same base for blocks, robots, given trials and simulators.

An effect is one mechanism that a model leaves out. How it acts forward on a simulation and inversely on a
recording depends on its domain: one channel of any table (`simgap.channels`), a hand that moves blocks
(`simgap.effects`), or a robot's logs and its simulator (`simgap.robot_effects`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

Array = Any  # np.ndarray, or a jax.Array under a trace
STATED = ("nominal", "sd", "unit", "low", "high", "effect", "fitted")  # by a simulator
GROSS = 100.0  # prior: largest fault in standard deviations; faults so large have been seen on the bench


@dataclass(frozen=True)
class Parameter:
    """A parameter with a normal prior: mean `nominal`, standard deviation `sd`, in `unit`, within `low` and
    `high`.

    At its nominal value an effect changes nothing. `log`: the prior is normal in the logarithm, with median
    `nominal` and `sd` in natural units. A search starts from each of `starts`. `hidden` parameters are fitted
    but not reported. A `shape` parameter modifies others and does nothing by itself. `name` is set by the
    effect that owns the parameter.

    In a simulator, parameters with the same `effect` act as one candidate cause; without one, a parameter is
    its own cause. A `fitted` parameter was never measured (a friction, say): it is fitted along with every
    cause and is not one itself.
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
        """The parameter's value at a standard normal coordinate."""
        return self.nominal * np.exp(self.sd * u) if self.log else self.nominal + self.sd * u

    def coordinate(self, value: float) -> float:
        """The inverse of `value`."""
        return float(np.log(value / self.nominal) / self.sd if self.log else (value - self.nominal) / self.sd)

    @property
    def limits(self) -> tuple[float, float]:
        """Bounds of the coordinate: at most five standard deviations of a logarithm, GROSS otherwise."""
        low = self.coordinate(self.low) if self.low > (0 if self.log else -np.inf) else -np.inf
        high = self.coordinate(self.high) if np.isfinite(self.high) else np.inf
        most = 5.0 if self.log else GROSS
        return max(low, -most), min(high, most)

    def scaled(self, factor: float, unit: str | None = None) -> Parameter:
        """The parameter of a quantity `factor` times as large, in another unit if one is given."""
        return replace(self, nominal=self.nominal * factor, sd=self.sd * factor, low=self.low * factor,
                       high=self.high * factor, starts=tuple(factor * s for s in self.starts),
                       unit=self.unit if unit is None else unit)  # fmt: skip


@dataclass(frozen=True)
class Effect:
    """One mechanism: its equation `says`, its `parameters` by name, and where it `shows`.

    It is `called` in plain words, and `check` says what to examine on the hardware.
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
        """Parameter values at which nothing is changed (if there are such)."""
        return {n: p.nominal for n, p in self.parameters.items()}
