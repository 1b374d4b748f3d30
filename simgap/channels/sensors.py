"""Effects of sensors on a channel: bias, drift, gain, lag and low-pass."""

from __future__ import annotations

import numpy as np

from simgap.channels import ChannelEffect, delayed, lowpass
from simgap.effect import Parameter

BIAS = ChannelEffect(
    name="bias",
    says="recorded = true + bias",
    shows="all of a recording alike, rest too",
    called="a zero error of a reading",
    check="Record two seconds at rest and compare with the model's value.",
    parameters={"bias": Parameter(0.0, 0.03, "")},
    read=lambda t, values, theta: values + theta["bias"],
    undo=lambda t, values, theta: values - theta["bias"],
)

DRIFT = ChannelEffect(
    name="drift",
    says="recorded = true + rate (t - t0)",
    shows="a ramp over the whole recording",
    called="a reading whose zero drifts",
    check="Record a minute at rest after switching on.",
    parameters={"rate": Parameter(0.0, 0.03, "/s")},
    read=lambda t, values, theta: values + theta["rate"] * t,
    undo=lambda t, values, theta: values - theta["rate"] * t,
)

GAIN = ChannelEffect(
    name="gain",
    says="recorded = (1 + gain) true",
    shows="course and fluctuation, in proportion",
    called="a reading that is off by a factor",
    check="Compare the sensor with a known load or distance; check its unit and scale.",
    parameters={"gain": Parameter(0.0, 0.03, "1", low=-0.9)},
    read=lambda t, values, theta: (1 + theta["gain"]) * values,
    undo=lambda t, values, theta: values / (1 + theta["gain"]),
)

LAG = ChannelEffect(
    name="lag",
    says="recorded(t) = true(t - delay)",
    shows="every change of the course, late",
    called="a reading that comes late",
    check="Compare time stamps of two channels at a sharp event.",
    # Late time stamps make the delay negative.
    parameters={"delay": Parameter(0.0, 0.01, "s", low=-0.2, high=0.5, starts=(0.03, 0.1, 0.3))},
    read=lambda t, values, theta: delayed(t, values, theta["delay"]),
    undo=lambda t, values, theta: np.interp(t + theta["delay"], t, values),
    remembers=True,
)

LOWPASS = ChannelEffect(
    name="lowpass",
    says="time_constant recorded' + recorded = true",
    shows="rounded changes, fast power gone",
    called="a slow filter in a reading",
    check="Look up the filter setting of this channel.",
    parameters={"time_constant": Parameter(0.0, 0.01, "s", low=0.0, high=0.5, starts=(0.01, 0.05, 0.2))},
    read=lambda t, values, theta: lowpass(t, values, theta["time_constant"]),
    undo=lambda t, values, theta: values + theta["time_constant"] * np.gradient(values, t),
    remembers=True,
)
