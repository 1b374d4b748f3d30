"""`hmmseg calibrate`, and `hmmseg diagnose --simulator` or `--mjcf`: a robot's logs against a model of it."""

from __future__ import annotations

import importlib.util
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from functools import partial
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from hmmseg.errors import InputError
from hmmseg.numbers import estimate, interval, shown_as
from hmmseg.tables import listed
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output, check_file, check_folder, distinct_trials, refuse, strict_json
from simgap.report.finding import sentence
from simgap.report.finding import tables as usual_tables

if TYPE_CHECKING:
    from rich.table import Table

    from simgap.progress import Progress
    from simgap.robot_effects.base import RobotEffect
    from simgap.robots.calibrate import Calibration
    from simgap.robots.changes import Changes
    from simgap.robots.diagnose import RobotDiagnosis
    from simgap.simulators.mjcf.load import Loaded
    from simgap.simulators.protocol import Simulator
    from simgap.simulators.recording import Recording


@dataclass(frozen=True)
class OwnSimulator:
    """The owner's model, as given on the command line."""

    simulator: str | None
    mjcf: Path | None
    map_file: Path | None
    candidates: Sequence[str]
    patch: Path | None
    history: Path | None = None
    rerun: Path | None = None

    @property
    def given(self) -> bool:
        """Whether a model was given; InputError for options that go only with one."""
        if self.mjcf is None:
            of_mjcf = {"--map": self.map_file, "--candidate": self.candidates}
            refuse("goes with a MuJoCo model, --mjcf XML", of_mjcf)
        elif self.simulator is not None:
            raise InputError("--mjcf", "does not go with --simulator", "one model")
        elif self.map_file is None:
            what = "which column is which joint, actuator or sensor of the model"
            raise InputError("--map", "missing", what)
        if self.simulator is None and self.mjcf is None:
            of_robots = {"--history": self.history, "--rerun": self.rerun}
            refuse("goes with a model of a robot, --mjcf XML", of_robots)
            return False
        return True

    def check_alone(self, others: Mapping[str, Any]) -> None:
        """InputError for options without meaning for an owner's model, and for unwritable destinations."""
        refuse("does not go with a simulator of your own", others)
        if self.patch is not None:
            check_folder("--patch", self.patch)
        if self.history is not None:
            from simgap.report.robot import history

            check_file("--history", self.history, (".jsonl",))
            history(self.history)
        if self.rerun is not None:
            check_file("--rerun", self.rerun, (".rrd",))
            if importlib.util.find_spec("rerun") is None:
                raise InputError("--rerun", "needs rerun-sdk", "pip install rerun-sdk")


def read_logs(
    out: Output, paths: Sequence[Path], own: OwnSimulator
) -> tuple[Simulator, list[Recording], Loaded | None]:
    """The simulator, logs of its channels, and the loaded MJCF if that is the model."""
    if own.simulator is not None:
        from simgap.simulators.recording import read_recording
        from simgap.simulators.user import load_simulator

        loaded, simulator = None, load_simulator(own.simulator)
        commands = [name for name, channel in simulator.channels.items() if channel.kind == "command"]
        logs = [read_recording(path, list(simulator.channels), commands=commands) for path in paths]
    else:
        from simgap.simulators.mjcf.load import load_mjcf

        assert own.mjcf is not None and own.map_file is not None
        loaded = load_mjcf(own.mjcf, own.map_file, own.candidates)
        simulator, logs = loaded.simulator, [loaded.read(path) for path in paths]
    out.warn(*(() if loaded is None else loaded.warnings), *(w for log in logs for w in log.warnings))
    return simulator, logs, loaded


def fitted_effects(
    simulator: Simulator, logs: Sequence[Recording], loaded: Loaded | None
) -> dict[str, RobotEffect]:
    """Effects fitted before anything else is asked: of an MJCF, all parameters that are rarely measured."""
    from simgap.robot_effects import UNMEASURED, effects_of

    if loaded is None:
        return effects_of(simulator, logs)
    return effects_of(simulator, logs, loaded.effects(logs), (*UNMEASURED, *loaded.map.sd))


@contextmanager
def show_stages(
    out: Output, text: str, total: int, over: Mapping[str, float] | None = None
) -> Iterator[Progress]:
    """Progress by stages; yields their callback. InputError if the simulation diverges far from the logs.

    `over`: share of the time that is over when a stage whose name begins so begins, from which the time left
    is told; without it stages are counted.
    """
    from numpy.linalg import LinAlgError

    from simgap.progress import heard

    stage, done, begun = text, 0.0, monotonic()

    def tell(text: str) -> None:
        nonlocal stage, done
        shares = [share for name, share in (over or {}).items() if text.startswith(name)]
        before, done = done, max(done, total * shares[0]) if shares else done + 1
        stage = text
        if shares:
            stage += f", about {(monotonic() - begun) * (total / done - 1):.0f} s left"
        advance(done - before, stage)

    with (
        out.progress(text, total=total, timed=not over) as advance,
        heard(lambda text: advance(0, f"{stage}: {text}")),
    ):
        try:
            yield tell
        except LinAlgError:
            near = "a model that stays near its logs: a shorter time step?"
            where = stage.partition(",")[0]
            raise InputError("simulator", f"runs far away from the logs ({where})", near) from None


def warn_of_engine(out: Output, own: OwnSimulator) -> None:
    """Warnings of MuJoCo, each once."""
    if own.mjcf is not None:
        from simgap.simulators.mjcf.engine import warned

        out.warn(*warned())


def calibrate(
    logs: opt.Trials, model: opt.RobotModel = None, map_file: opt.Map = None, simulator: opt.Simulator = None,
    patch: opt.Patch = None, json: opt.Json = None, seed: opt.UnusedSeed = 0, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """A robot's friction, rotor inertias, gains, delay: fitted to its logs, and what these leave open."""
    with Output("calibrate", json=json, seed=seed, quiet=quiet) as out:
        own = OwnSimulator(simulator, model, map_file, (), patch)
        if not own.given:
            raise InputError("--model", "missing", "--model XML --map MAP.toml, or --simulator FILE.py:NAME")
        own.check_alone({})
        from simgap.robots.calibrate import LEAVES, STAGES
        from simgap.robots.calibrate import calibrate as fit

        robot, recordings, loaded = read_logs(out, distinct_trials(logs), own)
        length = getattr(robot, "window", None) if loaded is None else loaded.map.length
        effects = fitted_effects(robot, recordings, loaded)
        with show_stages(out, "calibrating", STAGES) as tell:
            found = fit(robot, recordings, effects, length=length, tell=tell)
        warn_of_engine(out, own)
        out.warn(*(f"{name}: {times:.2g} times its noise is left, which nothing fitted explains; one that "
                   "stands in for it is off by more than its interval says (hmmseg diagnose seeks it)"
                   for name, times in found.left.items() if times > LEAVES**0.5))  # fmt: skip
        document = found.body()
        reasons = (f"{name}: {reason}" for name, reason in document["reasons"].items())
        out.print(*_calibration_tables(document), *reasons)
        if patch is not None:
            _patch(out, own, found.composed, found.point, document, _fitted(found))
        out.finish(document)


def _calibration_tables(document: dict[str, Any]) -> list[Table]:
    """Tables of parameters and of residuals on held-out logs."""
    sums = [
        {"name": " + ".join(n if c == 1 else f"{c:.3g} {n}" for n, c in one["of"].items()), **one}
        for one in document["combinations"]
    ]
    named = [{"name": n, **p} for n, p in (document["parameters"] | document["numerics"]).items()]
    rows = []
    for p in (*named, *sums):
        shown, value = shown_as(p["unit"]), ("undetermined", "")
        nominal = "" if "nominal" not in p else f"{shown[0] * p['nominal']:.4g} {shown[1]}"
        if p["mean"] is not None:
            low, high = p["interval_90"]
            value = estimate(p["mean"], p["sd"], shown), interval(low, high, shown)
        rows.append((p["name"], nominal, *value))
    heads = ("parameter", "the model has", "calibrated", "90 % interval")
    after = document["heldout"]["after"]
    rms = [(n, f"{v:.4g}", f"{after[n]:.4g}") for n, v in document["heldout"]["before"].items()]
    columns = ("channel", "as the model came", "calibrated")
    return [listed("parameters", heads, rows), listed("free runs along held-out logs, rms", columns, rms)]


def diagnose_robot(
    out: Output, paths: Sequence[Path], own: OwnSimulator, task: Path | None, effect: Sequence[str]
) -> None:
    """Read, diagnose, and write table, figures, page, patch and document to the destinations of `out`."""
    from simgap.robots.describe import body
    from simgap.robots.diagnose import OVER, diagnose

    at_risk, recordings, loaded = read_logs(out, paths, own)
    more = [] if loaded is None else loaded.effects(recordings)
    length = None if loaded is None else loaded.map.length
    phases = None
    if task is not None:
        from hmmseg.io.task import read_task
        from simgap.robots.rows import phases_by_task

        phases = phases_by_task(recordings, read_task(task), f"--task {task}")
    with show_stages(out, "diagnosing", 1, OVER) as tell:
        found = diagnose(at_risk, recordings, forced=tuple(dict.fromkeys(effect)), seed=out.seed, more=more,
                         length=length, phases=phases, tell=tell, warn=out.warn, note=out.print)  # fmt: skip
    document = body(found)
    warn_of_engine(out, own)
    headline, left = sentence(document), document["remainder"]["rms_over_noise"]
    size = [] if "times the noise" in headline else [f"What is left is {left:.3g} times the noise."]
    out.print(headline, *size, *tables(document, found))
    _deliver(out, own, found, document, loaded, recordings, found.composed.effects)
    if own.patch is not None:
        corrected = found.composed, found.linear.point, document, document["causes"]
        if document["verdict"] == "unknown" and found.calibrated is not None:  # then the best model there is
            best = found.calibrated
            corrected = best.composed, best.point, document["calibrated"], _fitted(best)
        _patch(out, own, *corrected)
    out.finish(document)


def compare_robot(out: Output, paths: Sequence[Path], healthy: Sequence[Path], own: OwnSimulator) -> None:
    """Changes of a robot since its `healthy` logs: table, figure, page, patch and document."""
    from simgap.robots.changes import STAGES, changes

    simulator, logs, loaded = read_logs(out, [*paths, *healthy], own)
    effects = fitted_effects(simulator, logs, loaded)
    with show_stages(out, "comparing", STAGES) as tell:
        found = changes(simulator, logs[len(paths) :], logs[: len(paths)], effects, tell=tell)
    warn_of_engine(out, own)
    document = found.body()
    for b in document["broken"]:
        out.warn(f"{b['trial']}: {b['channel']} is {b['value']:.4g} at {b['time']:.3f} s, left out")
    out.print(sentence(document), *usual_tables(document))
    _deliver(out, own, found, document, loaded, logs[: len(paths)], effects)
    if own.patch is not None:
        whole, causes, best = found.composed, document["causes"], found.calibration
        point = {n: v for n, v in found.point().items() if not whole.effects[n].numeric}
        changed = {whole.effects[c].label(p) for c in causes for p in whole.effects[c].parameters}
        fitted = {} if best is None else document["calibrated"]["parameters"]
        ranges = document | {"parameters": {n: p for n, p in fitted.items() if n not in changed}}
        _patch(out, own, whole, point, ranges, [*causes, *([] if best is None else _fitted(best))])
    out.finish(document)


def _fitted(found: Calibration) -> list[str]:
    """Effects that were fitted, without the solver's own numbers."""
    return [n for n in dict.fromkeys(n for n, _ in found.names) if not found.composed.effects[n].numeric]


def _patch(out: Output, own: OwnSimulator, composed: Any, point: Any, document: Any, causes: Any) -> None:
    """Write the corrected model, and say where, and what has no place in an MJCF."""
    from simgap.robots.patch import write_patch

    folder = own.patch
    assert folder is not None
    write_patch(composed, point, document, causes, own.mjcf, lambda name: out.stage(folder / name))
    ranges, model = folder / "ranges.json", "" if own.mjcf is None else f" and {own.mjcf.name}"
    out.print(f"what was found is in {ranges}{model}")
    for line in json.loads(out.stage(ranges).read_text(encoding="utf-8")).get("not_in_xml", ()):
        out.warn(f"--patch: an MJCF has no place for {line}; correct the driver by ranges.json")


def _deliver(
    out: Output, own: OwnSimulator, found: RobotDiagnosis | Changes, document: dict[str, Any],
    loaded: Loaded | None, logs: Sequence[Recording], effects: Mapping[str, RobotEffect],
) -> None:  # fmt: skip
    """Write history, the motion to run next, courses for Rerun, figures and the page."""
    from simgap.report import robot

    units = robot.own_units(loaded)
    if own.history is not None:
        past, now = robot.history(own.history), robot.intervals(document)
        document["history"] = robot.compared(past, now)
        out.print(*_history(document["history"], now))
        today = {"date": date.today().isoformat(), "files": [log.name for log in logs], "parameters": now}
        runs = (json.loads(strict_json(run)) for run in (*past, today))
        lines = "".join(json.dumps(run, ensure_ascii=False) + "\n" for run in runs)
        out.stage(own.history).write_text(lines, encoding="utf-8")
    folder = own.patch or out.figures or (out.report.parent if out.report is not None else None)
    asked, place = (document.get("next_experiment") or {}).get("log"), None
    motion = next((log for log in logs if log.name == asked), None)
    if motion is not None and folder is not None:
        name = "next_motion.csv"
        while any(log.name == name for log in logs):  # the motion that was asked for last time
            name = f"next_{name}"
        place = folder / name
        time = ("t", 1.0) if loaded is None else (loaded.map.clock.column, loaded.map.clock.size)
        commands = [n for n, c in found.composed.simulator.channels.items() if c.kind == "command"]
        text = robot.motion_csv(motion, commands, units, time)
        out.stage(place).write_text(text, encoding="utf-8")
        document["next_experiment"]["file"] = str(place)
        out.print(f"the motion to run next is in {place}")
    if own.rerun is not None:
        robot.write_rerun(out.stage(own.rerun), robot.courses(found, units))
    if out.figures is None and out.report is None:
        return
    from simgap.report.figures import draw_robot

    draw = partial(draw_robot, found, document, units)
    if out.figures is not None:
        draw(out.figure)
    if out.report is not None:
        from hmmseg_cli.pages import Setting, page

        shows = {n: e.says for n, e in effects.items()}
        setting = Setting(
            [log.name for log in logs], shows=shows, warnings=out.warnings, own=units,
            motion="" if place is None else os.path.relpath(place, out.report.parent),
        )  # fmt: skip
        out.stage(out.report).write_text(page(document, setting, draw), encoding="utf-8")


def _history(compared: Mapping[str, Any], now: Mapping[str, Any]) -> list[Any]:
    """Table of the changes of each parameter since it was last known."""
    if not compared:
        return [f"the history begins with this run: {len(now)} parameters"]
    rows = []
    for name, p in compared.items():
        ends = ("" if v is None else f"{v:.4g} {p['unit']}" for v in (p["then"], p["now"]))
        rows.append((name, *ends, p["since"], p["says"]))
    return [listed("since it was known last", ("parameter", "then", "now", "since", ""), rows, wraps=True)]


def tables(document: Mapping[str, Any], found: RobotDiagnosis) -> list[Table]:
    """What the logs leave open, the tables of every diagnosis, and held-out residuals."""
    rows, unseen = list[tuple[str, ...]](), document["identifiability"]["unseen"]
    for one in document["identifiability"]["alike"][:6]:
        near = f"are alike but for {100 * one['own']:.1f} %"
        how = "the first acts as the others" if one["exact"] else near
        rows.append((", ".join(one["parameters"]), how))
    rows += [(", ".join(unseen[:8]), "cannot be seen")] if unseen else []
    out = [listed("what these logs leave open", (), rows)] if rows else []
    out += usual_tables(document)
    if document["shrinkage"] is not None:
        heads = ("channel", "before", "after", "noise")
        noise, rows = found.composed.noise, []
        for n, v in document["shrinkage"]["rms"].items():
            rows.append((f"{n} [{v['unit']}]", f"{v['before']:.4g}", f"{v['after']:.4g}", f"{noise[n]:.2g}"))
        title = f"residual on {document['shrinkage']['evaluated_on']}, rms"
        out.append(listed(title, heads, rows, right=heads[1:]))
    return out
