"""`--report` of identify: one self-contained page, figures inside."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from estimation.identification import Identification
from estimation.plots import draw_check, draw_corner, draw_estimates
from estimation.report import Actual
from hmmseg.hand.signals import Signals
from hmmseg.io.trial import Trial
from hmmseg.numbers import SHOWN, estimate, interval, plain, shown_as
from hmmseg.plot.signals import draw_signals
from hmmseg.segmentation.spans import Segmentation
from hmmseg_cli.pages import embedded, rendered


def identification_page(
    signals: Sequence[Signals], trials: Sequence[Trial], segmentations: Sequence[Segmentation],
    body: dict[str, Any], found: Identification | None, measured: Actual | None, warnings: Sequence[str],
) -> str:  # fmt: skip
    """HTML of one identification."""
    figures = [
        picture(
            lambda p: draw_estimates(body["properties"], measured, p), "Estimates with 68 and 95 % intervals"
        )
    ]
    if found is not None and found.names:
        draws, names = found.draws, found.names
        figures.append(
            picture(lambda p: draw_corner(draws, names, p, measured), "Posterior of all properties")
        )
    return rendered(
        "identify.html.j2", method=body["method"], objects=list(body["properties"]),
        verdict=[_verdict(obj, entry) for obj, entry in body["properties"].items()],
        warnings=warnings, measured=measured is not None, rows=_rows(body, measured), figures=figures,
        trials=[_trial(i, s, t, g, found)
                for i, (s, t, g) in enumerate(zip(signals, trials, segmentations, strict=True))],
        sampler=body["sampler"], predictive=_checks(body.get("predictive")), notes=body.get("notes", ()),
    )  # fmt: skip


def picture(draw: Callable[[Path], Any], caption: str) -> dict[str, str]:
    """A figure as base64 PNG with its caption."""
    with tempfile.TemporaryDirectory(prefix="hmmseg-") as folder:
        path = Path(folder) / "figure.png"
        draw(path)
        return {"data": embedded(path), "caption": caption}


def _trial(i: int, signals: Signals, trial: Trial, segmentation: Segmentation,
           found: Identification | None) -> dict[str, Any]:  # fmt: skip
    pictures = [
        picture(lambda p: draw_signals(signals, segmentation, p), "Signals with subtasks and boundaries")
    ]
    if found is not None:
        identified = found
        pictures.append(
            picture(lambda p: draw_check(identified, i, p), "Recorded samples in their predicted bands")
        )
    evidence = segmentation.log_evidence
    return {
        "name": trial.name, "rate": f"{segmentation.rate:.4g}", "complete": segmentation.complete,
        "log_evidence": "none" if evidence is None else f"{evidence:.1f}", "figures": pictures,
        "spans": [
            (s.label, s.state, f"{s.start:.3f}",
             f"{s.start_90[0]:.3f} to {s.start_90[1]:.3f}" if s.start_sd else "", f"{s.end:.3f}")
            for s in segmentation.spans
        ],
    }  # fmt: skip


def _checks(predictive: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    """Posterior-predictive checks as rows."""
    return [
        (name, plain(check["p_value"], 2),
         estimate(check["scatter_between_grips"], 0, shown_as("N" if name == "force" else "m")))
        for name, check in (predictive or {}).items()
    ]  # fmt: skip


def _verdict(obj: str, entry: dict[str, Any]) -> str:
    parts = []
    for prop, verb in (("weight", "weighs"), ("width", "is"), ("height", "is")):
        if entry.get(prop):
            value = estimate(entry[prop]["mean"], entry[prop]["sd"], SHOWN[prop])
            parts.append(f"{verb} {value}" + {"weight": "", "width": " wide", "height": " high"}[prop])
    friction = entry.get("friction")
    if friction and friction.get("mean") is not None:
        parts.append(f"has a friction coefficient of {estimate(friction['mean'], friction['sd'])}")
    elif friction:
        parts.append(f"has a friction coefficient of at least {plain(friction['lower_bound'])}")
    return f"{obj} {', '.join(parts)}." if parts else f"Nothing could be determined of {obj}."


def _rows(body: dict[str, Any], measured: Actual | None) -> list[tuple[str, ...]]:
    """Block, property, estimate, intervals, what was measured and the deviation from it, source."""
    rows = []
    for obj, entries in body["properties"].items():
        for prop, entry in entries.items():
            value = (measured or {}).get(obj, {}).get(prop)
            source, shown = body["reasons"].get(f"{obj}.{prop}", ""), SHOWN[prop]
            text, inner, outer, deviation = "unknown", "", "", ""
            if entry is not None:
                source = ", ".join(entry.get("subtasks", ()))
                text = f"≥ {plain(entry['lower_bound'])}" if "lower_bound" in entry else ""
                if entry.get("mean") is not None:
                    text = estimate(entry["mean"], entry["sd"], shown)
                    inner = interval(entry["interval_68"][0], entry["interval_68"][1], shown, sds=2.0)
                    outer = interval(entry["interval_95"][0], entry["interval_95"][1], shown, sds=3.9)
                    if value is not None:
                        deviation = f"{100 * (entry['mean'] / value[0] - 1):+.2f} %"
                        if body.get("actual", {}).get(obj, {}).get(prop, {}).get("disagrees"):
                            deviation += ", disagrees"
            apart = (
                (estimate(value[0], value[1], shown) if value is not None else "", deviation)
                if measured
                else ()
            )
            rows.append((obj, prop, text, inner, outer, *apart, source))
    return rows
