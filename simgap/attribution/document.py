"""What every diagnosis says of a gap, as entries of the JSON document."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from simgap.attribution.cells import Cell
from simgap.attribution.detection import Detection
from simgap.attribution.verdict import Verdict

Rows = list[dict[str, Any]]


def entries(
    verdict: Verdict,
    detection: Detection,
    remainder: tuple[float, float | None, Rows],
    attribution: Mapping[str, tuple[float, float, tuple[float, float]]],
    where: Rows,
) -> dict[str, Any]:
    """Verdict, detection, remainder (share, p-value, where), every effect's probability, share of the
    gap and its 90 % interval, and where. A gap that is none, or does not matter, lies nowhere."""
    gap = verdict.verdict != "none"
    share, p_value, places = remainder
    return {
        "verdict": verdict.verdict,
        "causes": list(verdict.causes),
        "indistinguishable": list(verdict.indistinguishable),
        "probabilities": verdict.probabilities,
        "detection": {
            "p_value": detection.p_value,
            "statistic": detection.statistic,
            "resolution": detection.resolution,
        },
        "remainder": {"share": share, "p_value": p_value, "where": places if gap else []},
        "attribution": {
            name: {"probability": chance, "share": share, "interval_90": list(interval)}
            for name, (chance, share, interval) in sorted(attribution.items(), key=lambda item: -item[1][0])
        },
        "where": where if gap else [],
    }  # fmt: skip


def rows(cells: Iterable[Cell]) -> Rows:
    """Cells as the document lists them."""
    return [
        {"trial": c.trial, "channel": c.channel, "subtask": c.part,
         "band": list(c.band), "share": c.share, "z": c.z}
        for c in cells
    ]  # fmt: skip
