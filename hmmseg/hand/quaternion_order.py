"""A quaternion in the order w, x, y, z: the tool's own share is then explained better in the other order."""

from __future__ import annotations

import json

import numpy as np

from hmmseg.errors import InputError
from hmmseg.hand.pose import pose_of
from hmmseg.hand.tool import Tool, free_tool
from hmmseg.io.rig import Rig
from hmmseg.io.trial import Trial

BETTER = 0.8  # chosen: of the noise; over a hundred samples that are none another's so much is beyond chance


def order_warnings(trial: Trial, rig: Rig, tool: Tool, free: np.ndarray) -> tuple[str, ...]:
    """A line where free motion, samples `free` (num_timesteps,), goes with the order w, x, y, z.

    Only of a hand that turns enough to weigh its tool apart from the sensor's offset: else any order will do.
    """
    gripper = rig.gripper
    if gripper is None or gripper.quaternion is None or not tool.weighed:
        return ()
    rolled = (*gripper.quaternion[1:], gripper.quaternion[0])
    other = gripper.model_copy(update={"quaternion": rolled})
    try:
        found = free_tool(trial, rig.model_copy(update={"gripper": other}), pose_of(trial, other), free)
    except InputError:
        return ()
    if found.noise > BETTER * tool.noise:
        return ()
    where = f"{trial.file}: columns {', '.join(gripper.quaternion)}"
    problem = f"explain the hand's own share {tool.noise / found.noise:.2g} times better as w, x, y, z"
    return (f"{where} {problem}; expected quaternion = {json.dumps(list(rolled))} under [gripper]",)
