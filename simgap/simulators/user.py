"""A simulator out of a user's Python file: `my_robot.py:Robot`."""

from __future__ import annotations

import importlib.util
import inspect
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from hmmseg.errors import InputError, nearest
from simgap.simulators.protocol import Channel, Parameter, Simulator

BY_LOG = ("shift", "offset")  # what each log may have of its own (`simgap.robot_effects.by_log`)


@dataclass(frozen=True)
class UserSimulator:
    """A user's object with its parameters and channels checked; what it offers beyond them is kept."""

    parameters: Mapping[str, Parameter]
    channels: Mapping[str, Channel]
    simulate: Callable[..., Any]
    restarts: bool
    state_at: Callable[..., Any] | None = None
    contacts: Callable[..., Any] | None = None
    simulate_many: Callable[..., Any] | None = None
    says: Mapping[str, str] = field(default_factory=dict)
    poses: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    by_log: Mapping[str, Parameter] = field(default_factory=dict)
    numerics: frozenset[str] = frozenset()
    window: float | None = None  # s


def load_simulator(spec: str) -> UserSimulator:
    """The simulator NAME of a file, from `FILE.py:NAME`: an object, a class (made without arguments) or a
    function with attributes `parameters` and `channels`.

    InputError where the file or the name is missing, its code fails, or what it declares cannot be used.
    """
    file, _, name = spec.rpartition(":")
    where = f"--simulator {spec}"
    if not file or not name.isidentifier():
        raise InputError(where, "names no object", "FILE.py:NAME")
    path = Path(file)
    if not path.is_file():
        raise InputError(where, f"no such file {file}", "a Python file")
    module_spec = importlib.util.spec_from_file_location(path.stem, path)
    if module_spec is None or module_spec.loader is None:
        raise InputError(where, f"{file} is no Python file", "FILE.py:NAME")
    module = importlib.util.module_from_spec(module_spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    try:
        module_spec.loader.exec_module(module)
        if not hasattr(module, name):
            known = [n for n in vars(module) if not n.startswith("_")]
            raise InputError(where, f"{file} has no {name}", nearest(name, known))
        found = getattr(module, name)
        found = found() if inspect.isclass(found) else found
    except InputError:
        raise
    except Exception as error:  # whatever a user's file may do
        raise InputError(where, f"{type(error).__name__}: {error}", "a file that runs") from error
    return checked(found, where)


def checked(found: Any, where: str) -> UserSimulator:
    """The object as a simulator; InputError names the attribute, parameter or channel at fault."""
    run = found if inspect.isfunction(found) else getattr(found, "simulate", None)
    for name in ("parameters", "channels"):
        if not isinstance(getattr(found, name, None), Mapping):
            raise InputError(where, f"has no mapping {name!r}", "parameters, channels and simulate")
    if not callable(run):
        raise InputError(where, "cannot be run", "a method simulate(parameters, recording, start=None)")
    parameters = {n: _made(Parameter, v, f"{where}: parameter {n}") for n, v in found.parameters.items()}
    channels = {n: _made(Channel, v, f"{where}: channel {n}") for n, v in found.channels.items()}
    if all(c.kind == "command" for c in channels.values()):
        raise InputError(where, "has no channel to compare", "one that is no command")
    optional = {n: getattr(found, n, None) for n in ("state_at", "contacts", "simulate_many")}
    says = dict(getattr(found, "says", None) or {})
    restarted = "start" in inspect.signature(run).parameters
    given = getattr(found, "by_log", None) or {}
    by_log = {n: _made(Parameter, v, f"{where}: by_log {n}") for n, v in given.items()}
    for name in by_log:
        if name not in BY_LOG:
            raise InputError(f"{where}: by_log {name}", "unknown key", nearest(name, BY_LOG))
    poses = dict(getattr(found, "poses", None) or {})
    numerics = frozenset(getattr(found, "numerics", None) or ())
    for name in numerics - parameters.keys():
        raise InputError(f"{where}: numerics", f"no parameter {name}", nearest(name, list(parameters)))
    window = getattr(found, "window", None)
    if window is not None and not (isinstance(window, int | float) and 0 < window < math.inf):
        raise InputError(f"{where}: window", f"{window!r}", "seconds above 0")
    return UserSimulator(
        parameters,
        channels,
        run,
        restarted,
        says=says,
        poses=poses,
        by_log=by_log,
        numerics=numerics,
        window=window,
        **optional,
    )


def _made(kind: type, value: Any, where: str) -> Any:
    """A Parameter or Channel from one, or from a dict of its fields."""
    if isinstance(value, kind):
        return value
    if not isinstance(value, Mapping):
        raise InputError(where, f"is {type(value).__name__}", f"a {kind.__name__} or a dict")
    known = [f.name for f in fields(kind)]
    for key in value:
        if key not in known:
            raise InputError(f"{where}: {key}", "unknown key", nearest(str(key), known))
    try:
        return kind(**value)
    except (TypeError, ValueError) as error:
        raise InputError(where, str(error)) from None


def restarts(simulator: Simulator) -> bool:
    """Whether it can be started from a given state."""
    declared = getattr(simulator, "restarts", None)
    return bool("start" in inspect.signature(simulator.simulate).parameters if declared is None else declared)
