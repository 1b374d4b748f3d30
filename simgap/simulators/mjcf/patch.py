"""The XML with what was found in it: the file's own text, only the attributes that change touched."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simgap.robots.model import Composed, Point
from simgap.simulators.mjcf.engine import mujoco
from simgap.simulators.mjcf.setting import object_id


def patched(model: Path, composed: Composed, point: Point, changed: Sequence[str]) -> tuple[str, list[str]]:
    """The XML's text with some effects at a point, and those that no attribute of it holds.

    Values are written where the file states the object; inertia that geoms imply is stated explicitly. What
    is no MJCF (a URDF) is written as MuJoCo has it.
    """
    simulator: Any = composed.simulator
    text, untouched = text_of(model), []
    parameters = composed.parameters(point)
    for one in changed:
        effect = composed.effects[one]
        if not effect.model:
            untouched.append(f"{one}: {effect.says}")
            continue
        for name in effect.model.values():
            there = _written(text, simulator, name, parameters)
            if there is None:
                untouched.append(f"{name}: {effect.says}")
            else:
                text = there
    return text, untouched


def text_of(model: Path) -> str:
    """A model as MJCF."""
    text = model.read_text(encoding="utf-8")
    if re.search(r"<mujoco\b[^>]*>", text) and "<robot" not in text:
        return text
    spec = mujoco.MjSpec.from_file(str(model))
    spec.compile()
    return spec.to_xml()


def _written(text: str, simulator, name: str, parameters: Mapping[str, float]) -> str | None:
    """The text with one setting in it, None where it has no place."""
    kind, thing, attribute, index = simulator.settings[name].xml or ("", "", "", None)
    model, value = simulator.model, parameters[name]
    if kind == "body" and attribute in ("mass", "ipos"):
        return _inertial(text, model, thing, parameters)
    if kind == "option":
        stated = _option(model, name.removeprefix("option."), attribute, value, parameters)
        return None if stated is None else option_set(text, {attribute: stated})
    if kind == "actuator":
        stated = _actuator(model, thing, attribute, value)
        return None if stated is None else attribute_set(text, r"[a-z]+", thing, {attribute: stated})
    if kind not in ("joint", "body", "geom"):
        return None
    stated = number(value) if kind == "joint" else _array(model, kind, thing, attribute, index, value)
    return attribute_set(text, kind, thing, {attribute: stated})


def _array(model, kind: str, thing: str, attribute: str, index: int | None, value: float) -> str:
    """An attribute of several numbers: one of them at a value, or all larger by a share."""
    stated = np.array(getattr(model, f"{kind}_{attribute}")[object_id(model, kind, thing)])
    if index is None:
        return numbers(stated * (1 + value))
    stated[index] = value
    return numbers(stated)


def _actuator(model, thing: str, attribute: str, value: float) -> str | None:
    if attribute == "kp":
        return number(model.actuator_gainprm[object_id(model, "actuator", thing), 0] * (1 + value))
    return {"kv": number(value), "forcerange": numbers([-value, value])}.get(attribute)


def _option(model, name: str, attribute: str, value: float, parameters: Mapping[str, float]) -> str | None:
    if attribute == "timestep":
        return number(model.opt.timestep * max(1 + value, 0.25))
    if attribute != "gravity":
        return None
    down = np.array(model.opt.gravity)
    tilts = [
        parameters.get(f"option.tilt_{axis}", 0.0) * np.cross(np.eye(3)[k], down)
        for k, axis in enumerate("xy")
    ]
    return numbers(down + sum(tilts))


def _inertial(text: str, model, body: str, parameters: Mapping[str, float]) -> str | None:
    """The body with an explicit inertial element at its new values."""
    b = object_id(model, "body", body)
    mass = parameters.get(f"body:{body}.mass", float(model.body_mass[b]))
    scale = mass / float(model.body_mass[b])
    com = [parameters.get(f"body:{body}.com_{a}", float(model.body_ipos[b][k])) for k, a in enumerate("xyz")]
    element = (
        f'<inertial pos="{numbers(com)}" quat="{numbers(model.body_iquat[b])}" mass="{number(mass)}" '
        f'diaginertia="{numbers(model.body_inertia[b] * scale)}"/>'
    )
    opening = re.search(rf'([ \t]*)<body\b[^>]*\bname="{re.escape(body)}"[^>]*>', text)
    if opening is None:
        return None
    after = text[opening.end() :]
    own = re.match(r"\s*<inertial\b[^>]*/>", after)
    if own is not None:
        return (
            text[: opening.end()] + re.sub(r"<inertial\b[^>]*/>", element, own.group(0)) + after[own.end() :]
        )
    return text[: opening.end()] + f"\n{opening.group(1)}  {element}" + after


def attribute_set(text: str, tag: str, name: str, values: Mapping[str, str]) -> str | None:
    """The text with attributes of the element of this tag and name set; None where there is none."""
    found = re.search(rf'<{tag}\b[^>]*\bname="{re.escape(name)}"[^>]*?(/?)>', text)
    return None if found is None else _set(text, found, values)


def option_set(text: str, values: Mapping[str, str]) -> str | None:
    """The text with attributes of the option element set, which is made where there is none."""
    found = re.search(r"<option\b[^>]*?(/?)>", text)
    if found is not None:
        return _set(text, found, values)
    opening = re.search(r"<mujoco\b[^>]*>", text)
    if opening is None:
        return None
    attributes = " ".join(f'{k}="{v}"' for k, v in values.items())
    return f"{text[: opening.end()]}\n  <option {attributes}/>{text[opening.end() :]}"


def _set(text: str, found: re.Match, values: Mapping[str, str]) -> str:
    element = found.group(0)
    for key, value in values.items():
        there = re.search(rf'\b{key}="[^"]*"', element)
        if there is not None:
            element = element[: there.start()] + f'{key}="{value}"' + element[there.end() :]
        else:
            end = element.rindex("/>" if element.endswith("/>") else ">")
            element = element[:end].rstrip() + f' {key}="{value}"' + element[end:]
    return text[: found.start()] + element + text[found.end() :]


def number(value: float) -> str:
    """A number to six digits."""
    return f"{float(value):.6g}"


def numbers(values) -> str:
    """Numbers as MJCF has them."""
    return " ".join(number(v) for v in values)
