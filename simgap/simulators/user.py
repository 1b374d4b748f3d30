"""A simulator in a user's Python file: `my_robot.py:Robot`.

A user's code runs within `calling`, and what it returns is checked by `Checks`: whatever it does, the error
is one line that names its file and line.
"""

import functools
import importlib.util
import inspect
import math
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from hmmseg.errors import InputError, nearest
from simgap.effect import STATED, Parameter
from simgap.simulators.protocol import Channel, Channels, Job, Simulator, Values, finite
from simgap.simulators.recording import Recording

Kind = TypeVar("Kind", Parameter, Channel)
PATIENCE = 300.0  # limit: s that one call may take, unless the simulator states a `timeout`
LONGEST = 1e6  # limit: s; more is a slip of the pen
BY_LOG = ("shift", "offset")  # what may differ between logs (`simgap.robot_effects.readouts`)


@dataclass(frozen=True)
class UserSimulator:
    """A user's object with checked parameters and channels, and what else it offers."""

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
    """Load a simulator from a user's Python file.

    Args:
        spec: `FILE.py:NAME`; the name is of an object, a class (made without arguments) or a function with
            attributes `parameters` and `channels`.

    Returns:
        The simulator, with all calls checked.

    Raises:
        InputError: The file or the name is missing, its code fails, or what it declares cannot be used.
    """
    file, _, name = spec.rpartition(":")
    where = f"--simulator {spec}"
    if not file or not name.isidentifier():
        raise InputError(where, "names no object", "FILE.py:NAME")
    path = Path(file)
    if not path.is_file():
        raise InputError(where, f"no such file {file}", "a Python file")
    module_name = f"hmmseg_simulator_{path.stem}"  # a file called scipy.py does not replace SciPy
    module_spec = importlib.util.spec_from_file_location(module_name, path)
    if module_spec is None or module_spec.loader is None:
        raise InputError(where, f"{file} is no Python file", "FILE.py:NAME")
    module = importlib.util.module_from_spec(module_spec)
    sys.modules[module_name] = module  # dataclasses look their module up
    with calling(where, str(path), "a file that runs"):
        module_spec.loader.exec_module(module)
        if not hasattr(module, name):
            known = [n for n in vars(module) if not n.startswith("_")]
            raise InputError(where, f"{file} has no {name}", nearest(name, known))
        found = getattr(module, name)
        found = found() if inspect.isclass(found) else found
    return checked(found, where)


class _Late(BaseException):
    """A call takes too long. No `except Exception` of the user's catches it."""


@contextmanager
def calling(where: str, file: str, expected: str = "", patience: float = PATIENCE) -> Iterator[None]:
    """Run a user's code: whatever it raises becomes an InputError with the line of its `file`, except for an
    interrupt. So does more than `patience` [s] in the main thread of a POSIX system."""
    timed = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()

    def late(*_: Any) -> None:
        raise _Late

    try:
        usual = signal.signal(signal.SIGALRM, late) if timed else None
        try:
            if timed:
                signal.setitimer(signal.ITIMER_REAL, patience, 1.0)  # again, where a callback dropped it
            yield
        finally:
            if timed:
                signal.setitimer(signal.ITIMER_REAL, 0)
                signal.signal(signal.SIGALRM, usual or signal.SIG_DFL)
    except (InputError, KeyboardInterrupt):
        raise
    except _Late as error:
        raise InputError(_line(error, where, file), f"took more than {patience:g} s", "a run that ends"
                         ) from None  # fmt: skip
    except BaseException as error:  # SystemExit among them
        said = " ".join(str(error).split())[:SAID]
        raise InputError(_line(error, where, file), f"{type(error).__name__}: {said}", expected) from error


def _line(error: BaseException, where: str, file: str) -> str:
    """The last line of the user's own file on the way to an exception; `where` if there is none."""
    if isinstance(error, SyntaxError) and error.lineno is not None:
        return f"{error.filename}, line {error.lineno}"
    frames = traceback.extract_tb(error.__traceback__)
    own = [f for f in frames if Path(f.filename).resolve() == Path(file).resolve()]
    return f"{file}, line {own[-1].lineno}" if own else where


@dataclass(frozen=True)
class Checks:
    """Checked calls of a user's functions."""

    where: str  # they are named
    file: str
    patience: float  # [s] with a call
    channels: tuple[str, ...]  # that a run must return

    def call(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call a function."""
        with calling(self.where, self.file, patience=self.patience):
            return function(*args)

    def simulate(self, run: Callable[..., Any], parameters: Values, recording: Recording,
                 start: Values | None = None) -> Channels:  # fmt: skip
        """One run, with copies of all that it might change."""
        more = () if start is None else (dict(start),)
        return self.given_back(run, self.call(run, dict(parameters), _lent(recording), *more), recording)

    def simulate_many(self, run: Callable[..., Any], jobs: Sequence[Job]) -> list[Channels | None]:
        """Several runs at once."""
        lent = [Job(dict(j.parameters), _lent(j.recording), j.start) for j in jobs]
        found = self.call(lambda: list(run(lent)))
        if len(found) != len(jobs):
            raise InputError(self.of(run), f"gave {len(found)} runs", f"{len(jobs)}, one for each job")
        return [None if f is None else finite(self.given_back(run, f, j.recording))
                for f, j in zip(found, jobs, strict=True)]  # fmt: skip

    def state_at(self, run: Callable[..., Any], recording: Recording, t: float) -> dict[str, Any]:
        """State name -> (value, standard deviation)."""
        found = self.call(run, _lent(recording), t)
        try:
            out = {str(n): (float(v), float(sd)) for n, (v, sd) in dict(found).items()}
        except (TypeError, ValueError, OverflowError):
            expected = "{state: (value, standard deviation)}"
            raise InputError(self.of(run), f"gave {_shown(found)}", expected) from None
        for name, (value, sd) in out.items():
            if not (math.isfinite(value) and math.isfinite(sd) and sd >= 0):
                wrong = f"state {name}: {value} with standard deviation {sd}"
                raise InputError(self.of(run), wrong, "numbers")
        return out

    def contacts(self, run: Callable[..., Any], recording: Recording) -> list[float]:
        """Times [s]."""
        found = self.call(run, _lent(recording))
        times = _numbers(found)
        if times is None or times.ndim != 1 or not np.isfinite(times).all():
            raise InputError(self.of(run), f"gave {_shown(found)}", "times [s] in one row")
        return [float(t) for t in times]

    def given_back(self, run: Callable[..., Any], found: Any, recording: Recording) -> Channels:
        """A run's channels as arrays (num_timesteps,); InputError names the one at fault."""
        if not isinstance(found, Mapping):
            raise InputError(self.of(run), f"gave {_shown(found)}", "a dict of channels")
        out, rows = {}, len(recording)
        for name in self.channels:
            if name not in found:
                raise InputError(self.of(run), f"gave no channel {name!r}", f"{', '.join(self.channels)}")
            with calling(self.where, self.file):
                shape = np.shape(found[name])
            where, gave = f"{self.of(run)}: channel {name}", f"gave {_shown(found[name])}"
            if shape != (rows,):
                raise InputError(where, gave, f"{rows} numbers, one for each time")
            values = _numbers(found[name])
            if values is None:
                raise InputError(where, gave, "real numbers")
            out[name] = values
        return out

    def of(self, run: Callable[..., Any]) -> str:
        """A function's file and line, or how the command named it."""
        code = getattr(inspect.unwrap(getattr(run, "__func__", run)), "__code__", None)
        return self.where if code is None else f"{code.co_filename}, line {code.co_firstlineno}"


SAID = 200  # look: characters of a user's own message


def _numbers(value: Any) -> np.ndarray | None:
    """A copy of real numbers, integers and booleans included; None of anything else."""
    try:
        found = np.asarray(value)
        return np.array(found, float) if found.dtype.kind in "biufO" else None
    except (TypeError, ValueError, OverflowError):
        return None


def _shown(value: Any) -> str:
    """What a value is, in a few words."""
    if isinstance(value, np.ndarray):
        return f"an array {value.shape} of {value.dtype}"
    if isinstance(value, str) or not isinstance(value, Sequence):
        return "None" if value is None else f"{type(value).__name__} {str(value)[:40]!r}"
    return f"{type(value).__name__} of {len(value)}"


def _lent(recording: Recording) -> Recording:
    """The recording with read-only arrays."""

    def lent(values: np.ndarray) -> np.ndarray:
        out = values.view()
        out.flags.writeable = False
        return out

    columns = {name: lent(values) for name, values in recording.columns.items()}
    return replace(recording, t=lent(recording.t), columns=columns)


def checked(found: Any, where: str) -> UserSimulator:
    """Check a user's object; InputError names the attribute, parameter or channel at fault."""
    file = where.removeprefix("--simulator ").rpartition(":")[0]
    with calling(where, file):
        return _checked(found, where, file)


def _checked(found: Any, where: str, file: str) -> UserSimulator:
    def own(name: str) -> Any:
        return getattr(found, name, None)

    run = found if inspect.isfunction(found) else own("simulate")
    for name in ("parameters", "channels"):
        if not isinstance(own(name), Mapping):
            raise InputError(where, f"has no mapping {name!r}", "parameters, channels and simulate")
    if not callable(run):
        raise InputError(where, "cannot be run", "a method simulate(parameters, recording, start=None)")
    parameters = {n: _made(Parameter, v, f"{where}: parameter {n}") for n, v in own("parameters").items()}
    channels = {n: _made(Channel, v, f"{where}: channel {n}") for n, v in own("channels").items()}
    by_log = {n: _made(Parameter, v, f"{where}: by_log {n}") for n, v in (own("by_log") or {}).items()}
    compared = tuple(n for n, c in channels.items() if c.kind != "command")
    if not compared:
        raise InputError(where, "has no channel to compare", "one that is no command")
    for name in ("window", "timeout"):
        value = own(name)
        if value is not None and not (isinstance(value, int | float) and 0 < value <= LONGEST):
            raise InputError(f"{where}: {name}", f"{value!r}", f"seconds above 0, {LONGEST:g} at most")
    numerics = frozenset(own("numerics") or ())
    for what, names, known in (("by_log", by_log, BY_LOG), ("numerics", numerics, list(parameters))):
        for name in (n for n in names if n not in known):
            raise InputError(f"{where}: {what}", f"no parameter {name}", nearest(name, known))
    checks = Checks(where, file, float(own("timeout") or PATIENCE), compared)
    offered = {n: own(n) for n in ("state_at", "contacts", "simulate_many")}
    return UserSimulator(
        parameters, channels, functools.partial(checks.simulate, run),
        "start" in inspect.signature(run).parameters, says=dict(own("says") or {}),
        poses=dict(own("poses") or {}), by_log=by_log, numerics=numerics, window=own("window"),
        **{n: functools.partial(getattr(checks, n), f) for n, f in offered.items() if f is not None},
    )  # fmt: skip


def _made(kind: type[Kind], value: Any, where: str) -> Kind:
    """A Parameter or Channel from one, or from a dict of its fields."""
    if isinstance(value, kind):
        return value
    if not isinstance(value, Mapping):
        raise InputError(where, f"is {type(value).__name__}", f"a {kind.__name__} or a dict")
    known = STATED if kind is Parameter else [f.name for f in fields(kind)]
    for key in value:
        if key not in known:
            raise InputError(f"{where}: {key}", "unknown key", nearest(str(key), known))
    try:
        return kind(**value)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(where, str(error)) from None


def restarts(simulator: Simulator) -> bool:
    """Whether a simulator can be started from a given state."""
    declared = getattr(simulator, "restarts", None)
    return bool("start" in inspect.signature(simulator.simulate).parameters if declared is None else declared)
