"""Real tosses of a cube against MuJoCo's model of it with the published parameters.

    python -m experiments.real.contactnets FOLDER [--output FILE.json] [--figures DIR]

FOLDER holds tosses.csv and source_params.json (DAIRLab/contact-nets). Every toss is a log of the cube's pose;
the model is built from the published mass, side, friction and inertia. TOSSES of them, evenly chosen, are
taken, without the SEEN ones on which the settings of the method were chosen.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.real.robot_gap import asked, published
from simgap.robots.diagnose import RobotDiagnosis, diagnose
from simgap.simulators.mjcf.load import load_mjcf

SEEN, TOSSES = 16, 20
SOURCE_UNIT = 0.0524  # m: half of the published side
POSE = {"x": "x", "y": "y", "z": "z", "qw": "qw", "qx": "qx", "qy": "qy", "qz": "qz"}


def model_text(params: dict) -> str:
    """The cube on a board, as MJCF, by the published parameters (given in units of SOURCE_UNIT)."""
    half = SOURCE_UNIT
    inertia = params["inertia"] * SOURCE_UNIT**2
    return f"""<mujoco model="cube">
  <option timestep="0.0016891892" integrator="implicitfast" cone="elliptic" gravity="0 0 -9.81"/>
  <worldbody>
    <geom name="board" type="plane" size="2 2 0.1" friction="{params["mu"]} 0.005 0.0001"/>
    <body name="cube">
      <freejoint name="pose"/>
      <inertial pos="0 0 0" mass="{params["mass"]}" diaginertia="{inertia:.6g} {inertia:.6g} {inertia:.6g}"/>
      <geom name="box" type="box" size="{half} {half} {half}" friction="{params["mu"]} 0.005 0.0001"/>
    </body>
  </worldbody>
</mujoco>
"""


def map_text() -> str:
    """Which column is which component of the cube's pose."""
    return "window = 0.2\n" + "".join(
        f'[columns.{c}]\nbody = "cube"\naxis = "{a}"\n' for c, a in POSE.items()
    )


def write_inputs(folder: Path, into: Path, count: int = TOSSES) -> list[Path]:
    """Model, map and one CSV a toss in `into`; paths of the tosses."""
    params = json.loads((folder / "source_params.json").read_text(encoding="utf-8"))
    (into / "cube.xml").write_text(model_text(params), encoding="utf-8")
    (into / "map.toml").write_text(map_text(), encoding="utf-8")
    tosses: Any = pd.read_csv(folder / "tosses.csv")
    numbers = np.unique(tosses.toss)
    numbers = np.setdiff1d(numbers, evenly(numbers, SEEN))
    out = []
    for number in evenly(numbers, count):
        path = into / f"toss_{number:03d}.csv"
        tosses[tosses.toss == number][["t", *POSE]].to_csv(path, index=False)
        out.append(path)
    return out


def evenly(values: np.ndarray, count: int) -> np.ndarray:
    """At most so many of the values (n,), evenly chosen."""
    return values[np.linspace(0, values.size - 1, min(count, values.size)).round().astype(int)]


def run(folder: Path, count: int = TOSSES) -> RobotDiagnosis:
    """The diagnosis of the tosses."""
    with tempfile.TemporaryDirectory() as into:
        paths = write_inputs(folder, Path(into), count)
        loaded = load_mjcf(Path(into) / "cube.xml", Path(into) / "map.toml")
        logs = [loaded.read(p) for p in paths]
        more = loaded.effects(logs)
        return diagnose(loaded.simulator, logs, more=more, tell=print, length=loaded.map.length)


def main() -> None:
    """Run on a folder and write the results."""
    given = asked(__doc__ or "")
    published(run(given.folder), "contactnets", given.output, given.figures)


if __name__ == "__main__":
    main()
