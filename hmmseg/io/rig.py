"""The nominal hand: kinematics, fingertip pads, sensor noise and systematic uncertainty."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from hmmseg.errors import InputError, nearest

Positive = Annotated[float, Field(gt=0, strict=True)]  # inf allowed: a rigid pad
FinitePositive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Deviation = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Finger(_Table):
    """One planar two-link finger with absolute link angles (parallelogram linkage).

    tip = base + L1 (cos q1, sin q1) + L2 (cos q2, sin q2), all in m.
    """

    base: tuple[Finite, Finite]
    links: tuple[FinitePositive, FinitePositive]


class Fingertip(_Table):
    """Stiffness of one finger's pad [N/m]; `inf` is the paper's rigid fingertip."""

    normal_stiffness: Positive = float("inf")
    shear_stiffness: Positive = float("inf")


class Noise(_Table):
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


class Systematic(_Table):
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


class Rig(_Table):
    """The nominal hand as `rig.toml` describes it, SI units."""

    rate: FinitePositive | None = None
    gravity: FinitePositive = 9.80665
    fingers: dict[str, Finger] | None = None
    fingertip: Fingertip = Fingertip()
    noise: Noise = Noise()
    systematic: Systematic = Systematic()

    @model_validator(mode="after")
    def _two_fingers(self) -> Rig:
        if self.fingers is not None and sorted(self.fingers) != ["1", "2"]:
            raise ValueError("fingers must be the two tables [fingers.1] and [fingers.2]")
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


def _known_keys(location: tuple[Any, ...]) -> list[str]:
    tables: dict[str, type[_Table]] = {
        "fingertip": Fingertip, "noise": Noise, "systematic": Systematic,
    }  # fmt: skip
    if len(location) <= 1:
        return list(Rig.model_fields)
    head = str(location[0])
    return list((Finger if head == "fingers" else tables[head]).model_fields)


def parse_rig(table: dict[str, Any], where: str = "rig") -> Rig:
    """Rig from the table of a `rig.toml`; InputError names the key at fault."""
    try:
        return Rig.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            expected = nearest(str(first["loc"][-1]), _known_keys(first["loc"]))
            raise InputError(f"{where}: key {key}", "unknown key", expected) from None
        if first["type"] == "missing":
            raise InputError(f"{where}: key {key}", "missing", "a value") from None
        problem = f"{first['msg'].removeprefix('Value error, ')} (found {first.get('input')!r})"
        if first["type"] == "value_error":
            problem = first["msg"].removeprefix("Value error, ")
        raise InputError(f"{where}: key {key}" if key else where, problem) from None


def read_toml(path: str | Path) -> dict[str, Any]:
    """Table of a TOML file; InputError for an absent or malformed file."""
    path = Path(path)
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(str(path), "no such file", "a TOML file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(str(path), f"cannot be read ({error})", "a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(path), f"not valid TOML: {error}") from None


def read_rig(path: str | Path) -> Rig:
    """Rig from a `rig.toml` file; InputError for anything at fault."""
    return parse_rig(read_toml(path), str(path))
