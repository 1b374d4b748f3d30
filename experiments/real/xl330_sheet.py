"""The servo of `xl330.py` as an MJCF model from its data sheet: calibrated, and diagnosed.

    python -m experiments.real.xl330_sheet FOLDER [--diagnose] [--output FILE.json] [--figure FILE.png]

FOLDER has the logs xl330_*.csv; rows with the drive switched off are left out. Logs are left out of the fit
one by one, and run freely from their first sample. The figure shows one of them.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.real.xl330 import FULL
from experiments.saving import save
from hmmseg.plot.style import BLUE, INK, ORANGE, canvas
from simgap.robot_effects import STATED, UNMEASURED, effects_of
from simgap.robots.calibrate import LONGEST, calibrate
from simgap.robots.diagnose import diagnose
from simgap.robots.linear import base_at
from simgap.robots.model import Composed
from simgap.robots.rows import noises
from simgap.simulators.mjcf.load import Loaded, load_mjcf
from simgap.simulators.recording import Recording

# 0.52 N m and 104 rpm at 5 V, so at 7.3 V about 0.76 N m and 15.9 rad/s; rotor and friction are guesses.
MODEL = """<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 -9.81"/>
<worldbody><body name="arm">
<joint name="shaft" type="hinge" axis="0 -1 0" armature="0.0010" frictionloss="0.02" damping="0.002"/>
<inertial pos="0 0 -0.1" mass="0.49" diaginertia="8e-5 8e-5 8e-5"/></body></worldbody>
<actuator><general name="motor" joint="shaft" gainprm="0.76" biastype="affine" biasprm="0 0 -0.048"
ctrllimited="true" ctrlrange="-1 1"/></actuator></mujoco>"""
MAP = '[columns.position]\njoint = "shaft"\nunit = "rad"\n[columns.duty]\nactuator = "motor"\n'


def prepared(folder: Path, into: Path) -> list[Path]:
    """Write the logs with the model's columns."""
    out = []
    for path in sorted(folder.glob("xl330_*.csv")):
        log = pd.read_csv(path)
        log = log[log.torque_enable == 1].assign(duty=lambda d: (d.pwm / FULL).clip(-1, 1))
        out.append(into / path.name)
        log[["t", "position", "duty"]].to_csv(out[-1], index=False)
    return out


def draw(loaded: Loaded, logs: list[Recording], left_out: Recording, path: Path) -> None:
    """Draw a log that took no part in the fit, run freely from its first sample."""
    effects = effects_of(loaded.simulator, logs, loaded.effects(logs), UNMEASURED)
    found = calibrate(loaded.simulator, logs, effects, judged=False)
    mine = found.composed.effects
    whole = Composed.of(loaded.simulator, [left_out], mine, noises(loaded.simulator, logs), LONGEST)
    curves = {
        "model from the data sheet": (ORANGE, {n: e.neutral() for n, e in mine.items()}),
        "calibrated on other logs": (BLUE, found.point),
    }
    with canvas(path, height=2.4) as figure:
        axes = figure.add_subplot()
        axes.plot(left_out.t, np.rad2deg(left_out["position"]), color=INK, lw=1.6, label="recorded")
        for label, (colour, point) in curves.items():
            read = whole.read(whole.rolled(point, whole.starts(point)), point)
            for window, run in zip(whole.windows, read, strict=True):
                if run is not None:
                    times = left_out.t[window.begin : window.end]
                    axes.plot(times, np.rad2deg(run["position"]), color=colour, label=label)
        axes.set(xlabel="time [s]", ylabel="angle [deg]")
        axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--diagnose", action="store_true")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    out: dict = {}
    with tempfile.TemporaryDirectory() as name:
        into = Path(name)
        (into / "servo.xml").write_text(MODEL, encoding="utf-8")
        (into / "map.toml").write_text(MAP, encoding="utf-8")
        loaded = load_mjcf(into / "servo.xml", into / "map.toml")
        logs = [loaded.read(path) for path in prepared(given.folder, into)]
        if given.figure:
            draw(loaded, logs[:-1], logs[-1], given.figure)
            return
        more = loaded.effects(logs)
        for what, patterns in (("stated", STATED), ("stated and lacking", UNMEASURED)):
            begun = time.process_time()
            found = calibrate(loaded.simulator, logs, effects_of(loaded.simulator, logs, more, patterns))
            body = found.body() | {"processor": time.process_time() - begun}
            out[what] = body
            before, after = (1e3 * body["heldout"][k]["position"] for k in ("before", "after"))
            left = found.composed.rows.observed - base_at(found.composed, found.point).rows
            body["left"] = found.composed.rows.rms(left)
            print(f"{what}: held-out logs {before:.0f} -> {after:.1f} mrad; logs of the fit: {body['left']}")
        if given.diagnose:
            begun = time.process_time()
            diagnosed = diagnose(loaded.simulator, logs, more=more)
            v = diagnosed.verdict
            out["diagnosis"] = {
                "verdict": v.verdict, "causes": v.causes, "indistinguishable": v.indistinguishable,
                "explanation": v.explanation, "rms_over_noise": v.over_noise, "doubts": v.doubts,
                "heldout": None if diagnosed.shrinkage is None else diagnosed.shrinkage.fraction,
                "processor": time.process_time() - begun,
            }  # fmt: skip
            print(out["diagnosis"])
    if given.output:
        save(given.output, out)


if __name__ == "__main__":
    main()
