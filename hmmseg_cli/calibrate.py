"""`hmmseg calibrate`: unmeasured parameters of a robot's model, fitted to its logs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hmmseg.errors import InputError
from hmmseg.numbers import estimate, interval, shown_as
from hmmseg.tables import listed
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output, distinct_trials
from hmmseg_cli.diagnose_robot import OwnSimulator, fitted_effects, read_logs, show_stages, warn_of_engine

if TYPE_CHECKING:
    from rich.table import Table


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
        from simgap.robots.calibrate import STAGES
        from simgap.robots.calibrate import calibrate as fitted
        from simgap.robots.patch import write_patch

        robot, recordings, loaded = read_logs(out, distinct_trials(logs), own)
        length = getattr(robot, "window", None) if loaded is None else loaded.map.length
        effects = fitted_effects(robot, recordings, loaded)
        with show_stages(out, "calibrating", STAGES) as tell:
            found = fitted(robot, recordings, effects, length=length, tell=tell)
        warn_of_engine(out, own)
        document = found.body()
        out.print(*tables(document), *(f"{name}: {reason}" for name, reason in document["reasons"].items()))
        if patch is not None:
            changed = [n for n in found.point if not found.composed.effects[n].numeric]
            given = found.composed, found.point, document, changed, model
            write_patch(*given, lambda name: out.stage(patch / name))
        out.finish(document)


def tables(document: dict[str, Any]) -> list[Table]:
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
            value = estimate(p["mean"], p["sd"], shown), interval(*p["interval_90"], shown=shown)
        rows.append((p["name"], nominal, *value))
    heads = ("parameter", "the model has", "calibrated", "90 % interval")
    after = document["heldout"]["after"]
    rms = [(n, f"{v:.4g}", f"{after[n]:.4g}") for n, v in document["heldout"]["before"].items()]
    columns = ("channel", "as the model came", "calibrated")
    return [listed("parameters", heads, rows), listed("free runs along held-out logs, rms", columns, rms)]
