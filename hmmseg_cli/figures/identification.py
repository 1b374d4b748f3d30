"""All figures of one identification."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from estimation.actual import Actual
from estimation.identification import Identification
from hmmseg.hand.signals import Signals
from hmmseg.io.trial import Trial
from hmmseg.segmentation.spans import Segmentation
from hmmseg_cli.console import Output
from hmmseg_cli.figures.corner import draw_corner
from hmmseg_cli.figures.estimates import draw_estimates
from hmmseg_cli.figures.predictive import Prediction, draw_predictive
from hmmseg_cli.figures.signals import draw_signals

UNITS = {
    "net vertical force": ("Net fy less\npredicted [N]", 1.0),
    "finger distance": ("Distance less\npredicted [mm]", 1e3),
}


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


def draw_check(found: Identification, trial: int, path: Path) -> None:
    """One trial's recorded signals less what the fitted model predicts, in its band."""
    from estimation.predicted import predicted_signals

    t, predicted = predicted_signals(found, trial)
    shown = []
    for p in predicted:
        label, factor = UNITS[p.name]
        around = (factor * (v - p.median) for v in (p.observed, p.low, p.median, p.high))
        shown.append(Prediction(label, *around))
    draw_predictive(t, shown, path, found.segmentations[trial])
