"""A real servo's logs: the verdict that the docs show, on a small sample of them."""

import pytest

from experiments.real import robot_gap

FOUR = [f"xl330_{n}" for n in ("kp100_sin_sin", "kp200_up_and_down", "kp400_lift_and_drop",
                               "kp800_sin_time_square")]  # fmt: skip
NOT_THERE = ("backlash", "delay", "spring", "stribeck", "sag", "mass", "length")


@pytest.mark.slow
def test_what_a_servo_lacks_is_named(shared):
    """One log a gain: friction by load, the rotor and a fade, and the logs left out are predicted."""
    found = robot_gap.summary(robot_gap.run(shared / "real/xl330_pendulum", FOUR))
    assert found["verdict"] in ("named", "set")
    causes = found["causes"]
    assert {"armature", "load_friction"} <= set(causes) and any(c.endswith("fade") for c in causes)
    assert not [c for c in causes for none in NOT_THERE if none in c]
    rms = found["shrinkage"]["rms"]["position"]
    assert rms["after"] < 0.5 * rms["before"] and found["remainder"]["share"] < 0.3
