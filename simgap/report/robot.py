"""What a robot's diagnosis leaves besides its document: courses, a history, the next motion to run."""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from pydantic import BaseModel
from scipy.stats import norm

from hmmseg.errors import InputError
from hmmseg.levels import CERTAIN
from simgap.robot_effects.base import NORMAL_90
from simgap.robots.changes import Changes
from simgap.robots.diagnose import RobotDiagnosis
from simgap.robots.linear import base_at
from simgap.simulators.recording import Recording

if TYPE_CHECKING:
    from simgap.simulators.mjcf.load import Loaded


@dataclass(frozen=True)
class Own:
    """How a log's column states a quantity: value in `si` = `offset` + `factor` * value in `unit`."""

    si: str
    factor: float
    offset: float
    unit: str

    def of(self, values: np.ndarray) -> np.ndarray:
        """SI values converted to the column's unit."""
        return (values - self.offset) / self.factor


def own_units(loaded: Loaded | None) -> dict[str, Own]:
    """Conversions of columns whose unit is not SI, by column and by what they measure (joint:elbow)."""
    out: dict[str, Own] = {}
    if loaded is None:
        return {}
    for name, m in loaded.map.columns.items():
        if isinstance(m.unit, str) and m.factor != 1.0:
            own = Own(loaded.simulator.channels[name].unit, m.factor, m.offset, m.unit)
            out |= {name: own, f"{m.thing}:{m.name}": own}
    return out


@dataclass(frozen=True)
class Course:
    """A channel of a log (n,) in its column's unit, NaN where a simulation restarts."""

    log: str
    channel: str
    unit: str
    t: np.ndarray  # [s]
    recorded: np.ndarray
    simulated: np.ndarray  # by the original model
    corrected: np.ndarray  # by the corrected one
    over: float  # mean square residual of the original model, in noise variances


def courses(found: RobotDiagnosis | Changes, own: Mapping[str, Own]) -> list[Course]:
    """The courses of all logs and channels. Logs of a diagnosis are predicted from the others if it was
    cross-validated; for changes, the simulation runs freely from the first sample."""
    rows = found.composed.rows
    if isinstance(found, Changes):
        simulated, corrected = (base_at(found.composed, p).rows for p in (found.old.point, found.point()))
    else:
        simulated, corrected = (rows.observed - left for left in residuals(found))
    out = []
    for log in np.unique(rows.log):
        for c, channel in enumerate(rows.channels):
            mine = (rows.log == log) & (rows.channel == c)
            if not mine.any():
                continue
            si = found.composed.simulator.channels[channel].unit
            says = own.get(channel, Own(si, 1.0, 0.0, si))
            gaps = np.flatnonzero(np.diff(rows.window[mine])) + 1
            square = (rows.observed - simulated)[mine] ** 2 / rows.variance[mine]
            t, recorded, without, with_it = (
                np.insert(values[mine], gaps, np.nan)
                for values in (rows.time, rows.observed, simulated, corrected)
            )
            out.append(Course(
                found.composed.recordings[log].name, channel, says.unit, t, says.of(recorded),
                says.of(without), says.of(with_it), float(np.nanmean(square)),
            ))  # fmt: skip
    return out


def residuals(found: RobotDiagnosis) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N,) before and after correction, held out if the diagnosis was cross-validated."""
    far = found.shrinkage
    return (found.plain.residual, found.linear.residual) if far is None else (far.plain, far.residual)


def motion_csv(
    log: Recording, commands: Sequence[str], own: Mapping[str, Own], time: tuple[str, float]
) -> str:
    """The commands of a motion as CSV in the columns' own units; `time`: its column and unit [s]."""
    columns = {time[0]: (log.t - log.t[0]) / time[1]}
    columns |= {n: own[n].of(log[n]) if n in own else log[n] for n in commands}
    return pd.DataFrame(columns).to_csv(index=False, float_format="%.9g", lineterminator="\n")


def intervals(document: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Every parameter of a diagnosis by name: calibrated, or of the named causes; null of a set's members."""
    keys = ("mean", "sd", "interval_90", "unit")
    known = (document.get("calibrated") or {}).get("parameters") or {}
    out = {name: {k: p.get(k) for k in keys} for name, p in known.items()}
    for name in (*document["causes"], *document["indistinguishable"]):
        found = document["effects"].get(name, {"parameters": {}})["parameters"]
        for short, p in found.items():
            told = {k: p.get(k) if document["verdict"] == "named" or k == "unit" else None for k in keys}
            out[name if len(found) == 1 else f"{name}.{short}"] = told
    return out


class _Known(BaseModel):
    mean: float | None
    interval_90: tuple[float, float] | None


class _Run(BaseModel):
    """A line of a history."""

    date: str
    parameters: dict[str, _Known]


def history(path: Path) -> list[dict[str, Any]]:
    """The runs in a history file, one line of JSON each; none if there is no file.

    Raises:
        InputError: A line is not a run.
    """
    if not path.exists():
        return []
    out = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            _Run.model_validate_json(line, strict=True)
        except ValueError:
            where = f"--history {path}: line {number}"
            raise InputError(where, "is no run of a history", '{"date": .., "parameters": ..}') from None
        out.append(json.loads(line))
    return out


def compared(
    past: Sequence[Mapping[str, Any]], now: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Compare each parameter of a run with its last known value: `moved` if they differ by more than both
    intervals allow (Bonferroni over all parameters), `within` if it lies in the old interval, else `cannot
    tell`, also if unknown now. Parameters never known before are left out."""
    out = {}
    reach = norm.isf((1 - CERTAIN) / 2 / max(len(now), 1))
    for name, p in now.items():
        known = ((e["date"], e["parameters"].get(name)) for e in reversed(past))
        date, then = next(((d, q) for d, q in known if q and q["mean"] is not None), (None, None))
        if then is None:
            continue
        answer = "cannot tell"
        if p["mean"] is not None and p["interval_90"] and then["interval_90"]:
            sds = [(q["interval_90"][1] - q["interval_90"][0]) / 2 / NORMAL_90 for q in (p, then)]
            low, high = then["interval_90"]
            if abs(p["mean"] - then["mean"]) > reach * np.hypot(*sds):
                answer = "moved"
            elif low <= p["mean"] <= high:
                answer = "within"
        out[name] = {"since": date, "then": then["mean"], "now": p["mean"], "unit": p["unit"], "says": answer}
    return out


def write_rerun(path: Path, found: Sequence[Course]) -> None:
    """Write recorded, simulated and corrected courses of all logs and channels for Rerun's viewer.

    Raises:
        InputError: rerun-sdk is not installed.
    """
    try:
        rerun: Any = importlib.import_module("rerun")
    except ImportError:
        raise InputError("--rerun", "needs rerun-sdk", "pip install rerun-sdk") from None
    stream = rerun.RecordingStream("hmmseg")
    stream.save(str(path))
    for one in found:
        index = [rerun.TimeColumn("time", duration=one.t[np.isfinite(one.t)])]
        for name in ("recorded", "simulated", "corrected"):
            values = getattr(one, name)[np.isfinite(one.t)]
            columns = rerun.Scalars.columns(scalars=values)
            stream.send_columns(f"{one.log}/{one.channel}/{name}", indexes=index, columns=columns)
    stream.flush()
