"""The nominal hand: kinematics, pads, a gripper's wrist sensor, noise and systematic uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator, model_validator

from hmmseg.errors import nearest
from hmmseg.io.schema import LARGEST, Deviation, Finite, FinitePositive, Name, Positive, StrictTable
from hmmseg.io.units import Columns

Link = Annotated[FinitePositive, Field(le=10)]  # limit: m; longer ones are in mm or cm
Gravity = Annotated[FinitePositive, Field(le=100)]  # limit: m/s^2; of any place where hands are
AXES = ("x", "y", "z")
Axis = Literal["x", "y", "z"]
Direction = Literal["x", "y", "z", "-x", "-y", "-z"]


def _by_axis(value: Any) -> Any:
    """Turn a list of three columns into a table by axis x, y, z."""
    if isinstance(value, list | tuple):
        if len(value) != 3:
            raise ValueError(f"has {len(value)} columns; expected x, y, z, or a table such as "
                             '{y = "ee_y", z = "ee_z"}')  # fmt: skip
        return dict(zip(AXES, value, strict=True))
    return value


def _several(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


ByAxis = Annotated[dict[Axis, Name], BeforeValidator(_by_axis)]
Opening = Annotated[tuple[Name, ...], BeforeValidator(_several), Field(min_length=1, max_length=2)]
Place = tuple[Finite, Finite, Finite]


class Gripper(StrictTable):
    """A parallel gripper: columns of the tool's pose, opening and wrench, and the tool on the sensor."""

    position: ByAxis = Field(default={"x": "x", "y": "y", "z": "z"})  # [m]; an absent axis does not move
    # Without an orientation the tool does not turn, and its axes are the world's.
    quaternion: tuple[Name, Name, Name, Name] | None = None  # x, y, z, w
    rotation_vector: tuple[Name, Name, Name] | None = None  # axis times angle [rad] instead
    up: Direction = "z"  # axis of the world against gravity
    opening: Opening = ("opening",)  # [m], or of each finger
    wrench: tuple[Name, ...] = ("fx", "fy", "fz")  # [N], and optionally tx, ty, tz [N m]
    frame: Literal["sensor", "tool", "world"] = "sensor"  # whose axes the wrench has
    # Axes of the tool along which the sensor's x, y, z point; by default found from free motion.
    sensor_axes: tuple[Direction, Direction, Direction] | None = None
    reaction: bool | None = None  # whether the environment exerts the wrench on the tool; found by default
    closing: Axis = "y"  # axis of the tool along which the pads close
    tool_mass: FinitePositive | None = None  # [kg]; found from free motion by default, as any offset is
    centre_of_mass: Place | None = None  # [m] from the sensor; forces do not need it
    fingertip: Place = (0.0, 0.0, 0.0)  # [m] middle of the pads, in the tool's axes
    grip_force: Name | FinitePositive | None = None  # [N] of each pad: a column or a number
    motor_current: Name | None = None  # [A], which times `force_per_ampere` [N/A] is the grip force
    force_per_ampere: FinitePositive | None = None

    @field_validator("wrench")
    @classmethod
    def _whole(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(names) not in (3, 6):
            raise ValueError(f"has {len(names)} columns; expected 3 forces, or 3 forces and 3 torques")
        return names

    @field_validator("sensor_axes")
    @classmethod
    def _right_handed(cls, axes: tuple[str, ...] | None) -> tuple[str, ...] | None:
        import numpy as np  # slow to import, and only grippers need it

        if axes is not None and not np.isclose(np.linalg.det(np.stack([direction(a) for a in axes])), 1):
            raise ValueError(f"{', '.join(axes)} are no right-handed axes; expected such as y, x, -z")
        return axes

    @model_validator(mode="after")
    def _consistent(self) -> Gripper:
        if self.quaternion is not None and self.rotation_vector is not None:
            raise ValueError("has both quaternion and rotation_vector; expected one of them")
        if self.up.lstrip("-") not in self.position:
            raise ValueError(f"position has no column for {self.up.lstrip('-')}, the axis that is up")
        if self.force_per_ampere is not None and self.motor_current is None:
            raise ValueError("has force_per_ampere without motor_current")
        return self

    @property
    def channels(self) -> tuple[str, ...]:
        """All channels that a trial of this gripper needs."""
        force = self.grip_force if isinstance(self.grip_force, str) else None
        named = (
            *self.position.values(), *(self.quaternion or ()), *(self.rotation_vector or ()), *self.opening,
            *self.wrench, force, self.motor_current,
        )  # fmt: skip
        return tuple(dict.fromkeys(name for name in named if name is not None))

    @property
    def turns(self) -> bool:
        """Whether the tool's orientation is recorded."""
        return self.quaternion is not None or self.rotation_vector is not None


def direction(axis: str) -> Any:
    """Unit vector (3,), an array, along an axis such as `-z`."""
    import numpy as np  # as above

    return (-1.0 if axis[0] == "-" else 1.0) * np.eye(3)[AXES.index(axis[-1])]


class Finger(StrictTable):
    """One planar two-link finger with absolute link angles: tip = base + sum of L (cos q, sin q), in m."""

    base: tuple[Finite, Finite]
    links: tuple[Link, Link]


class Fingertip(StrictTable):
    """Stiffness of one finger's pad [N/m]; `inf` is the paper's rigid fingertip."""

    normal_stiffness: Positive = float("inf")
    shear_stiffness: Positive = float("inf")


class Noise(StrictTable):
    """Noise standard deviations of one sample; None is learned from the recording."""

    angle: FinitePositive | None = None  # [rad] of a jointed hand
    position: FinitePositive | None = None  # [m] of a Cartesian one
    velocity: FinitePositive | None = None  # [rad/s] or [m/s]
    force: FinitePositive | None = None  # [N]


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
_Forces = Annotated[_Four, _per_entry(FORCE_CHANNELS)]


class Systematic(StrictTable):
    """Standard deviations of errors common to all trials, relative if no unit is said; one number for all."""

    force_bias: _Forces = (0.0, 0.0, 0.0, 0.0)  # [N]
    force_gain: _Forces = (0.0, 0.0, 0.0, 0.0)
    joint_offset: Annotated[_Four, _per_entry(JOINTS)] = (0.0, 0.0, 0.0, 0.0)  # [rad]
    link_length: Annotated[_Four, _per_entry(("11", "12", "21", "22"))] = (0.0, 0.0, 0.0, 0.0)
    pad_stiffness: Annotated[tuple[Deviation, Deviation], _per_entry(("1", "2"))] = (0.0, 0.0)


class Tolerance(StrictTable):
    """The smallest gap that matters: `position` [m], `force` [N], `property` (share); None if unstated."""

    position: FinitePositive | None = None
    force: FinitePositive | None = None
    property: FinitePositive | None = None


class Rig(StrictTable):
    """The nominal hand as `rig.toml` describes it, SI units."""

    @classmethod
    def read(cls, source: str | Path | dict[str, Any] | Rig) -> Rig:
        """Read the description of a hand.

        Args:
            source: a `rig.toml`, its table as a dict, or a rig, which is returned as it is.

        Returns:
            The rig, lengths in m, forces in N, angles in rad, stiffnesses in N/m.

        Raises:
            InputError: names the key at fault, and the nearest known one.
        """
        if isinstance(source, Rig):
            return source
        return parse_rig(source) if isinstance(source, dict) else read_rig(Path(str(source)))

    rate: FinitePositive | None = None
    gravity: Gravity = 9.80665
    fingers: dict[str, Finger] | None = None
    fingertip: Fingertip = Fingertip()
    noise: Noise = Noise()
    systematic: Systematic = Systematic()
    tolerance: Tolerance = Tolerance()
    gripper: Gripper | None = None
    columns: Columns = Field(default={})
    topics: Columns = Field(default={})
    effects: dict[Name, dict[Name, Finite]] = Field(default={})  # of the virtual model, for `simulate` alone

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

    @property
    def wrist(self) -> Gripper:
        """The gripper with a wrist sensor; ValueError for any other hand."""
        if self.gripper is None:
            raise ValueError("a hand of fingertips has no wrist sensor")
        return self.gripper

    def finger(self, i: int) -> Finger:
        """Finger 1 (left) or 2 (right); ValueError for a Cartesian hand."""
        if self.fingers is None:
            raise ValueError("a Cartesian hand has no fingers")
        return self.fingers[str(i)]


def parse_rig(table: dict[str, Any], where: str = "rig") -> Rig:
    """Rig from the table of a `rig.toml`; InputError names the key at fault."""
    return Rig.validated(table, where)


def read_rig(path: str | Path) -> Rig:
    """Rig from a `rig.toml` file; InputError for anything at fault."""
    return Rig.from_toml(path)
