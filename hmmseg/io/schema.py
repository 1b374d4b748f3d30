"""Strict TOML and JSON tables: reading, and validation that reports a fault in one line."""

import json
import re
import tomllib
import typing
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from hmmseg.errors import InputError, nearest

LARGEST = 1e12  # numerics: SI units; squares of larger numbers overflow sooner or later


def _rigid(value: float) -> float:
    if LARGEST < value < float("inf"):
        raise ValueError(f"found {value:.3g}; expected at most {LARGEST:.0e}, or inf")
    return value


Positive = Annotated[float, Field(gt=0, strict=True), AfterValidator(_rigid)]  # inf allowed: a rigid pad
FinitePositive = Annotated[float, Field(gt=0, le=LARGEST, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False, strict=True)]
Deviation = Annotated[float, Field(ge=0, le=LARGEST, allow_inf_nan=False, strict=True)]
Name = Annotated[str, Field(min_length=1, max_length=500, strict=True)]
MAX_TOML_BYTES = 1_000_000  # limit: bytes; more is a damaged or hostile file
DEEPEST = 32  # limit: parts of a dotted key
SEPARATOR, JOINT = re.compile(r"[=,{}\[\]\n]"), re.compile(r"[\w\"'-]\s*\.(?=\s*[\w\"'-])")


T = TypeVar("T", bound="StrictTable")


class StrictTable(BaseModel):
    """A frozen table that refuses keys it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    @classmethod
    def validated(cls: type[T], table: dict[str, Any], where: str) -> T:
        """The table as this model; InputError names the key at fault and the nearest known one."""
        try:
            return cls.model_validate(table)
        except ValidationError as error:
            first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = _known_keys(cls, first["loc"])
            raise InputError(f"{where}: key {key}", "unknown key", nearest(str(first["loc"][-1]), known))
        if first["type"] == "missing":
            raise InputError(f"{where}: key {key}", "missing", "a value")
        problem = first["msg"].removeprefix("Value error, ")
        if first["type"] != "value_error":
            found = repr(first.get("input"))
            problem += f" (found {found if len(found) < 100 else found[:100] + '...'})"
        raise InputError(f"{where}: key {key}" if key else where, problem)

    @classmethod
    def from_toml(cls: type[T], path: str | Path) -> T:
        """The same from a TOML file; InputError as well if it cannot be read."""
        return cls.validated(read_toml(path), str(path))


def _known_keys(model: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    """Keys of the table that contains the last, unknown part of `location`."""
    for part in location[:-1]:
        named = {field.alias or name: field for name, field in model.model_fields.items()}
        field = named.get(str(part))
        inner = None if field is None else _inner_model(field.annotation)
        model = inner if inner is not None else model  # keys of a table of tables are no fields
    return [field.alias or name for name, field in model.model_fields.items()]


def _inner_model(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in typing.get_args(annotation):
        found = _inner_model(argument)
        if found is not None:
            return found
    return None


def read_toml(path: str | Path) -> dict[str, Any]:
    """Table of a TOML file; InputError for an absent, malformed or hostile file."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            content = file.read(MAX_TOML_BYTES + 1)
        text = content.decode("utf-8")
    except FileNotFoundError:
        raise InputError(str(path), "no such file", "a TOML file") from None
    except (OSError, UnicodeDecodeError) as error:
        problem = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        raise InputError(str(path), problem, "a TOML file") from None
    if len(content) > MAX_TOML_BYTES:
        raise InputError(str(path), f"larger than {MAX_TOML_BYTES} bytes", "a TOML file")
    return parse_toml(text, str(path))


def read_json(path: str | Path, expected: str) -> dict[str, Any]:
    """Table of a JSON file; InputError naming what was `expected` for an absent or malformed file."""
    try:
        table = json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise InputError(str(path), "no such file", expected) from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(str(path), f"not valid JSON ({error})", expected) from None
    if not isinstance(table, dict):
        raise InputError(str(path), "holds no table", expected)
    return table


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Table of a TOML text; InputError for a malformed or hostile one."""
    if any(len(JOINT.findall(token)) > DEEPEST for token in SEPARATOR.split(text)):
        raise InputError(where, "not valid TOML: nested too deeply")  # tomllib would need gigabytes
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))  # Windows' editors mark UTF-8
    except RecursionError:
        raise InputError(where, "not valid TOML: nested too deeply") from None
    except ValueError as error:  # malformed, or a number of thousands of digits
        raise InputError(where, f"not valid TOML: {error}") from None
