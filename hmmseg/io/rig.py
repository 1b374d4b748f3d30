"""The nominal hand: kinematics, fingertip pads, sensor noise and systematic uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, model_validator

from hmmseg.errors import nearest
from hmmseg.io.columns import Columns
from hmmseg.io.gripper import Gripper
from hmmseg.io.schema import (
    LARGEST,
    Deviation,
    Finite,
    FinitePositive,
    Name,
    Positive,
    StrictTable,
    read_toml,
    validated,
)


class Finger(StrictTable):
    """One planar two-link finger with absolute link angles (parallelogram linkage).

    tip = base + L1 (cos q1, sin q1) + L2 (cos q2, sin q2), all in m.
    """

    base: tuple[Finite, Finite]
    links: tuple[FinitePositive, FinitePositive]


class Fingertip(StrictTable):
    """Stiffness of one finger's pad [N/m]; `inf` is the paper's rigid fingertip."""

    normal_stiffness: Positive = float("inf")
    shear_stiffness: Positive = float("inf")


class Noise(StrictTable):
    """Standard deviation of one sample; None is learned from the recording.

    A jointed hand gives `angle` [rad] and `velocity` [rad/s]; a Cartesian hand gives
    `position` [m] and `velocity` [m/s]; both give `force` [N].
    """

    angle: FinitePositive | None = None
    position: FinitePositive | None = None
    velocity: FinitePositive | None = None
    force: FinitePositive | None = None


def _per_entry(names: tuple[str, ...]) -> BeforeValidator:
    """Accept one number for all entries, a list in order, or a table by name."""

    def expand(value: Any) -> Any:
        if isinstance(value, bool):
            raise ValueError("must be a number")
        if isinstance(value, int | float):
            if abs(value) > LARGEST:
                raise ValueError(f"must be at most {LARGEST:.0e}")
            return (float(value),) * len(names)
        if isinstance(value, dict):
            for key in value:
                if key not in names:
                    raise ValueError(f"unknown entry {key}; expected {nearest(key, names)}")
            return tuple(value.get(name, 0.0) for name in names)
        return value

    return BeforeValidator(expand)


FORCE_CHANNELS = ("fx1", "fy1", "fx2", "fy2")
JOINTS = ("q11", "q12", "q21", "q22")
_Four = tuple[Deviation, Deviation, Deviation, Deviation]


class Systematic(StrictTable):
    """Standard deviations of what all trials share; 0 where absent.

    `force_bias` [N] and `force_gain` (relative) per finger and axis (fx1, fy1, fx2, fy2),
    `joint_offset` [rad] per joint (q11, q12, q21, q22), `link_length` per link (finger 1's two,
    then finger 2's) and `pad_stiffness` per finger, both relative. One number stands for all.
    """

    force_bias: Annotated[_Four, _per_entry(FORCE_CHANNELS)] = (0.0, 0.0, 0.0, 0.0)
    force_gain: Annotated[_Four, _per_entry(FORCE_CHANNELS)] = (0.0, 0.0, 0.0, 0.0)
    joint_offset: Annotated[_Four, _per_entry(JOINTS)] = (0.0, 0.0, 0.0, 0.0)
    link_length: Annotated[_Four, _per_entry(("11", "12", "21", "22"))] = (0.0, 0.0, 0.0, 0.0)
    pad_stiffness: Annotated[tuple[Deviation, Deviation], _per_entry(("1", "2"))] = (0.0, 0.0)


class Tolerance(StrictTable):
    """The smallest gap that matters: `position` [m], `force` [N], `property` (share); None where not said."""

    position: FinitePositive | None = None
    force: FinitePositive | None = None
    property: FinitePositive | None = None


class Rig(StrictTable):
    """The nominal hand as `rig.toml` describes it, SI units."""

    @classmethod
    def read(cls, source: str | Path | dict[str, Any] | Rig) -> Rig:
        """Rig from a `rig.toml`, its table as a dict, or a rig itself; InputError for anything at fault."""
        if isinstance(source, Rig):
            return source
        return parse_rig(source) if isinstance(source, dict) else read_rig(Path(str(source)))

    rate: FinitePositive | None = None
    gravity: FinitePositive = 9.80665
    fingers: dict[str, Finger] | None = None
    fingertip: Fingertip = Fingertip()
    noise: Noise = Noise()
    systematic: Systematic = Systematic()
    tolerance: Tolerance = Tolerance()
    gripper: Gripper | None = None
    columns: Columns = Field(default={})
    topics: Columns = Field(default={})
    effects: dict[Name, dict[Name, Finite]] = Field(default={})  # of the virtual model alone: simulate's

    @model_validator(mode="after")
    def _two_fingers(self) -> Rig:
        if self.fingers is not None and sorted(self.fingers) != ["1", "2"]:
            raise ValueError("fingers must be the two tables [fingers.1] and [fingers.2]")
        if self.fingers is not None and self.gripper is not None:
            raise ValueError("a hand has [fingers] or is a [gripper], not both")
        return self

    @property
    def jointed(self) -> bool:
        """Whether trials are recorded in joint space."""
        return self.fingers is not None

    def finger(self, i: int) -> Finger:
        """Finger 1 (left) or 2 (right); ValueError for a Cartesian hand."""
        if self.fingers is None:
            raise ValueError("a Cartesian hand has no fingers")
        return self.fingers[str(i)]


def parse_rig(table: dict[str, Any], where: str = "rig") -> Rig:
    """Rig from the table of a `rig.toml`; InputError names the key at fault."""
    return validated(Rig, table, where)


def read_rig(path: str | Path) -> Rig:
    """Rig from a `rig.toml` file; InputError for anything at fault."""
    return parse_rig(read_toml(path), str(path))
