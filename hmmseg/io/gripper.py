"""A parallel gripper with a force-torque sensor in the wrist, as `[gripper]` of `rig.toml` has it."""

from __future__ import annotations

from typing import Literal

from pydantic import field_validator

from hmmseg.io.schema import Finite, FinitePositive, Name, StrictTable


class Gripper(StrictTable):
    """Columns of the tool's pose, its opening and the wrench, and the tool that hangs on the sensor.

    `position` names the columns of the tool's position (x, y, z up) [m], `quaternion` those of its
    orientation (x, y, z, w; without it the tool keeps its axes along the world's), `opening` the
    distance between the pads [m], `wrench` fx, fy, fz [N] and where there are any tx, ty, tz [N m],
    given in `frame`. `reaction` says whether the wrench is what the environment does to the tool
    (as most sensors have it) rather than what the tool does. `closing` is the tool's axis along
    which the pads close. `tool_mass` [kg] and `centre_of_mass` [m] (tool frame, from the sensor)
    are found from free motion where they are not given. `grip_force` [N] or `motor_current` [A]
    name a column where there is one. `fingertip` is where the pads' middle lies [m] (tool frame,
    from the tool's position).
    """

    position: tuple[Name, Name, Name] = ("x", "y", "z")
    quaternion: tuple[Name, Name, Name, Name] | None = None
    opening: Name = "opening"
    wrench: tuple[Name, ...] = ("fx", "fy", "fz")
    frame: Literal["sensor", "world"] = "sensor"
    reaction: bool = True
    closing: Literal["x", "y", "z"] = "y"
    tool_mass: FinitePositive | None = None
    centre_of_mass: tuple[Finite, Finite, Finite] | None = None
    fingertip: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    grip_force: Name | None = None
    motor_current: Name | None = None

    @field_validator("wrench")
    @classmethod
    def _three_or_six(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if len(names) not in (3, 6):
            raise ValueError(f"has {len(names)} columns; expected 3 forces, or 3 forces and 3 torques")
        return names

    @property
    def channels(self) -> tuple[str, ...]:
        """Every channel a trial of this gripper needs."""
        optional = (self.grip_force, self.motor_current)
        return (
            *self.position, *(self.quaternion or ()), self.opening, *self.wrench,
            *(name for name in optional if name is not None),
        )  # fmt: skip
