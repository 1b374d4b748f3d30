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


def test_the_table_counts_by_run(monkeypatch):
    def case(tier: str, effects: list[str], verdict: str, causes: list[str], held_out: float) -> dict:
        found = {"verdict": verdict, "causes": causes, "indistinguishable": [], "seconds": 10.0,
                 "shrinkage": {"fraction": held_out}}  # fmt: skip
        return row({"case": "c", "tier": tier, "effects": effects}, found)

    rows = [
        case("healthy", ["none"], "none", [], 0.0),
        case("healthy", ["none"], "named", ["force_bias"], 0.1),
        case("single", ["force_bias"], "named", ["force_bias"], 0.9),
        case("single", ["force_bias"], "named", ["force_gain"], 0.5),
        case("pair", ["force_bias", "force_lag"], "named", ["force_lag"], 0.5),
    ]
    monkeypatch.setattr(gap_drawn, "load", lambda name: {"runs": {"before": rows[:1], "now": rows}})
    text = gap_drawn.table()
    assert text is not None
    cells = {line.split("|")[1].strip(): line.split("|")[2:4] for line in text.splitlines() if "|" in line}
    counts = {name: [cell.strip() for cell in pair] for name, pair in cells.items()}
    assert counts["healthy: none"] == ["1 of 1", "1 of 2"]
    assert counts["single: named alone"] == ["0 of 0", "1 of 2"]
    assert counts["single: another name"] == ["0 of 0", "1 of 2"]
    assert counts["pairs: one of both"] == ["0 of 0", "1 of 1"]
    assert counts["named with a held-out share below 0.3"] == ["0 of 0", "1 of 4"]
    assert "c force_bias (wrong name: force_gain)" in text
