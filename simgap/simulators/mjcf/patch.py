"""The XML with what was found in it: the file's own text, only the attributes that change touched."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from simgap.robots.diagnose import RobotDiagnosis
from simgap.simulators.mjcf.engine import mujoco


def patched(xml: Path, found: RobotDiagnosis) -> tuple[str, list[str]]:
    """The XML's text with the causes at their values, and the causes that no attribute of it holds.

    Values are written where the file states the object; inertia that geoms imply is stated explicitly.
    """
    simulator = found.composed.simulator
    text, untouched = xml.read_text(encoding="utf-8"), []
    parameters = found.composed.parameters(found.linear.point)
    for cause in found.verdict.causes:
        effect = found.composed.effects[cause]
        if not effect.model:
            untouched.append(f"{cause}: {effect.says}")
            continue
        for name in effect.model.values():
            changed = _written(text, simulator, name, parameters)
            if changed is None:
                untouched.append(f"{name}: {effect.says}")
            else:
                text = changed
    return text, untouched


def _written(text: str, simulator, name: str, parameters: Mapping[str, float]) -> str | None:
    """The text with one setting in it, None where it has no place."""
    kind, thing, attribute, index = simulator.settings[name].xml or ("", "", "", None)
    value = parameters[name]
    model = simulator.model
    if kind == "joint":
        return attribute_set(text, "joint", thing, {attribute: number(value)})
    if kind == "body" and attribute in ("mass", "ipos"):
        return _inertial(text, model, thing, name, parameters)
    if kind == "body" and attribute == "pos":
        b = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, thing)
        return attribute_set(text, "body", thing, {"pos": numbers(model.body_pos[b] * (1 + value))})
    if kind == "geom":
        g = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, thing)
        stated = {
            "friction": model.geom_friction,
            "solref": model.geom_solref,
            "solimp": model.geom_solimp,
            "size": model.geom_size,
        }[attribute][g].copy()
        if index is None:
            stated = stated * (1 + value)
        else:
            stated[index] = value
        return attribute_set(text, "geom", thing, {attribute: numbers(stated)})
    if kind == "actuator":
        a = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, thing)
        if attribute == "kp":
            return attribute_set(
                text, r"[a-z]+", thing, {"kp": number(model.actuator_gainprm[a, 0] * (1 + value))}
            )
        if attribute == "kv":
            return attribute_set(text, r"[a-z]+", thing, {"kv": number(value)})
        if attribute == "forcerange":
            return attribute_set(text, r"[a-z]+", thing, {"forcerange": numbers([-value, value])})
        return None
    if kind == "option" and attribute == "gravity":
        down = np.array(model.opt.gravity)
        turned = down.copy()
        for axis, key in enumerate(("option.tilt_x", "option.tilt_y")):
            turned = turned + np.cross(np.eye(3)[axis], down) * parameters.get(key, 0.0)
        return option_set(text, {"gravity": numbers(turned)})
    if kind == "option" and attribute == "timestep":
        step = model.opt.timestep * max(1 + value, 0.25)
        return option_set(text, {"timestep": number(step)})
    return None


def _inertial(text: str, model, body: str, name: str, parameters: Mapping[str, float]) -> str | None:
    """The body with an explicit inertial element at its new values."""
    b = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, body)
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
    told = " ".join(f'{k}="{v}"' for k, v in values.items())
    return f"{text[: opening.end()]}\n  <option {told}/>{text[opening.end() :]}"


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
