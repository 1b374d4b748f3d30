"""Effects of drives on a command: gain, offset, saturation, fading, dead band and backlash."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simgap.channels import ChannelEffect, play, sensors
from simgap.effect import Parameter

DRIVES = ("effort", "duty")  # commands with a natural zero
EVERY = (*DRIVES, "place")
LARGEST = "largest"  # key of `theta`: the largest absolute value commanded

BACKLASH = ChannelEffect(
    name="backlash",
    says="acted follows commanded through a gap of this width",
    called="play between a drive and what it moves",
    check="Hold the drive still and move the joint by hand.",
    parameters={"width": Parameter(0.0, 0.02, "", low=0.0)},
    read=lambda t, values, theta: play(values, theta["width"]),
    of=("place",),
    remembers=True,
)

DEAD_BAND = ChannelEffect(
    name="dead_band",
    says="acted = commanded less a band about 0",
    called="commands too small to do anything",
    check="Raise the command slowly from nothing and note where motion begins.",
    parameters={"band": Parameter(0.0, 0.03, "", low=0.0)},
    read=lambda t, values, theta: np.sign(values) * np.maximum(np.abs(values) - theta["band"], 0.0),
    of=DRIVES,
)

FADE = ChannelEffect(
    name="fade",
    says="acted = commanded (1 - fade |commanded| / largest)",
    called="a drive that falls behind large commands",
    check="Command a large constant torque and measure it.",
    parameters={"fade": Parameter(0.0, 0.1, "1", low=-0.9, high=0.9)},
    read=lambda t, values, theta: values * (1 - theta["fade"] * np.abs(values) / theta[LARGEST]),
    of=DRIVES,
)

GAIN = replace(
    sensors.GAIN,
    says="acted = (1 + gain) commanded",
    called="commands that are carried out too weakly or strongly",
    check="Command a known step and measure the motion.",
    of=EVERY,
)

OFFSET = ChannelEffect(
    name="offset",
    says="acted = commanded + offset",
    called="commands that are carried out with an offset",
    check="Command the home position and measure where the robot is.",
    parameters={"offset": Parameter(0.0, 0.03, "")},
    read=lambda t, values, theta: values + theta["offset"],
    of=("effort", "place"),
)

SATURATION = ChannelEffect(
    name="saturation",
    says="acted = commanded, up to (1 - lost) of the largest commanded",
    called="a drive that gives no more than so much",
    check="Look up the drive's current limit; command its largest torque and measure it.",
    parameters={"lost": Parameter(0.0, 0.1, "1", low=0.0, high=0.99)},
    read=lambda t, values, theta: np.clip(
        values, -(1 - theta["lost"]) * theta[LARGEST], (1 - theta["lost"]) * theta[LARGEST]
    ),
    of=EVERY,
)
