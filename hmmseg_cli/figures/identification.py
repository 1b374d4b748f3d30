"""All figures of one identification."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from estimation.identification import Identification
from estimation.plots import draw_check, draw_corner, draw_estimates
from estimation.report import Actual
from hmmseg.hand.signals import Signals
from hmmseg.io.trial import Trial
from hmmseg.plot.signals import draw_signals
from hmmseg.segmentation.spans import Segmentation
from hmmseg_cli.console import Output


def draw_all(
    out: Output, signals: Sequence[Signals], trials: Sequence[Trial], segmentations: Sequence[Segmentation],
    body: dict[str, Any], found: Identification | None, actual: Actual | None,
) -> None:  # fmt: skip
    """Signals with subtasks a trial, estimates, and of a Bayesian result corner and predictive check."""
    for i, (s, trial, segmentation) in enumerate(zip(signals, trials, segmentations, strict=True)):
        stem = Path(trial.name).stem
        draw_signals(s, segmentation, out.figure(f"{stem}_segments.png"))
        if found is not None:
            draw_check(found, i, out.figure(f"{stem}_predictive.png"))
    draw_estimates(body["properties"], actual, out.figure("estimates.png"))
    if found is not None and found.names:
        draw_corner(found.draws, found.names, out.figure("corner.png"), actual)
