"""What becomes of a diagnosis in a drawn lab, and its table."""

import pytest

from experiments import gap_drawn
from experiments.gap_drawn import outcome, row


@pytest.mark.parametrize(
    ("tier", "found", "expected"),
    [
        ("healthy", {"verdict": "none"}, "quiet"),
        ("healthy", {"verdict": "unknown"}, "false alarm"),
        ("healthy", {"error": "ValueError: no"}, "error"),
        ("single", {"verdict": "named", "causes": ["force_lag"]}, "named"),
        (
            "single",
            {"verdict": "set", "causes": ["force_lag"], "indistinguishable": ["force_lowpass"]},
            "set",
        ),
        (
            "single",
            {"verdict": "set", "causes": ["force_lowpass"], "indistinguishable": ["force_lag"]},
            "set",
        ),
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
    ],
)
def test_outcomes(tier, found, expected):
    effects = ["force_lag", "grip_slip"] if tier == "pair" else ["force_lag"]
    assert outcome({"tier": tier, "effects": effects}, found) == expected


def test_the_table_counts_what_gains_enough(monkeypatch):
    def case(tier: str, effect: str, verdict: str, causes: list[str], gain: float) -> dict:
        found = {"verdict": verdict, "causes": causes, "indistinguishable": [], "gains": {effect: gain},
                 "detection": {"p_value": 0.5}, "seconds": 10.0}  # fmt: skip
        return row({"case": "c", "tier": tier, "effects": [effect]}, found)

    rows = [
        case("healthy", "none", "none", [], 0.0),
        case("healthy", "none", "named", ["force_bias"], 0.0),
        case("single", "force_bias", "named", ["force_bias"], 100.0),
        case("single", "force_bias", "named", ["force_gain"], 100.0),
        case("single", "force_bias", "none", [], 0.1),  # need not be seen
    ]
    found = {"rows": rows, "seed": 1, "made_by": "abc"}
    monkeypatch.setattr(gap_drawn, "load", lambda name: found)
    text = gap_drawn.table()
    assert text is not None
    lines = {
        line.split("|")[1].strip(): line.split("|")[3].strip() for line in text.splitlines() if "|" in line
    }
    assert lines["false alarms on healthy recordings"] == "1 of 2"
    assert lines["single effects named, no other beside them"] == "1 of 2"
    assert lines["another name"] == "1 of 2"
    assert "force_bias (wrong name: force_gain)" in text
