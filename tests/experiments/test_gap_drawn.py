"""What becomes of a diagnosis in a drawn lab, and its table."""

import pytest

from experiments.gap_drawn import outcome


@pytest.mark.parametrize(("tier", "found", "expected"), [
    ("healthy", {"verdict": "none"}, "quiet"),
    ("healthy", {"verdict": "unknown"}, "false alarm"),
    ("healthy", {"error": "ValueError: no"}, "error"),
    ("single", {"verdict": "named", "causes": ["force_lag"]}, "named"),
    ("single", {"verdict": "set", "causes": ["force_lag"], "indistinguishable": ["force_lowpass"]},
     "set"),
    ("single", {"verdict": "set", "causes": ["force_lowpass"], "indistinguishable": ["force_lag"]},
     "set"),
    ("single", {"verdict": "named", "causes": ["clock_jitter", "force_lag"]}, "beside others"),
    ("single", {"verdict": "named", "causes": ["force_lowpass"], "indistinguishable": []}, "wrong name"),
    ("single", {"verdict": "none", "small_gap": {"size": 1.0}}, "too small"),
    ("single", {"verdict": "none"}, "missed"),
    ("single", {"verdict": "unknown"}, "unknown"),
    ("pair", {"verdict": "named", "causes": ["grip_slip", "force_lag"]}, "named"),
    ("pair", {"verdict": "named", "causes": ["force_lag"]}, "half"),
    ("pair", {"verdict": "set", "causes": ["table_tilt"]}, "wrong name"),
    ("pair", {"verdict": "unknown", "causes": []}, "unknown"),
    ("outside", {"verdict": "unknown", "causes": []}, "unknown"),
    ("outside", {"verdict": "named", "causes": ["table_tilt"]}, "wrong name"),
])  # fmt: skip
def test_outcomes(tier, found, expected):
    effects = ["force_lag", "grip_slip"] if tier == "pair" else ["force_lag"]
    assert outcome({"tier": tier, "effects": effects}, found) == expected
