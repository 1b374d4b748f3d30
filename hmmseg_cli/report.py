"""`--report` of identify: one self-contained page, figures inside."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jinja2

import hmmseg
from estimation.actual import Actual
from estimation.identification import Identification
from estimation.plot.corner import draw_corner
from estimation.plot.estimates import draw_estimates
from estimation.plot.predictive import draw_check
from hmmseg.hand.signals import Signals
from hmmseg.io.trial import Trial
from hmmseg.plot.signals import draw_signals
from hmmseg.segmentation.spans import Segmentation

SHOWN = {
    "weight": (1.0, "N", 4),
    "width": (100.0, "cm", 4),
    "height": (100.0, "cm", 4),
    "friction": (1.0, "", 3),
}


def identification_page(
    signals: Sequence[Signals], trials: Sequence[Trial], segmentations: Sequence[Segmentation],
    body: dict[str, Any], found: Identification | None, measured: Actual | None, warnings: Sequence[str],
) -> str:  # fmt: skip
    """HTML of one identification."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
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
    return environment.get_template("identify.html.j2").render(
        version=hmmseg.__version__, method=body["method"], objects=list(body["properties"]),
        verdict=[_verdict(obj, entry) for obj, entry in body["properties"].items()],
        warnings=warnings, measured=measured is not None, rows=_rows(body, measured), figures=figures,
        trials=[_trial(i, s, t, g, found)
                for i, (s, t, g) in enumerate(zip(signals, trials, segmentations, strict=True))],
        sampler=body["sampler"], predictive=body.get("predictive"),
    )  # fmt: skip


def picture(draw: Callable[[Path], Any], caption: str) -> dict[str, str]:
    """A figure as base64 PNG with its caption."""
    with tempfile.TemporaryDirectory(prefix="hmmseg-") as folder:
        path = Path(folder) / "figure.png"
        draw(path)
        return {"data": base64.b64encode(path.read_bytes()).decode(), "caption": caption}


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
            {"name": f"{s.subtask} {s.object or ''}", "state": s.state, "start": f"{s.start:.3f}",
             "interval": f"{s.start_90[0]:.3f} to {s.start_90[1]:.3f}" if s.start_sd else "",
             "end": f"{s.end:.3f}"}
            for s in segmentation.spans
        ],
    }  # fmt: skip


def _number(prop: str, value: float, unit: bool = False) -> str:
    factor, name, digits = SHOWN[prop]
    return f"{value * factor:.{digits}f}" + (f" {name}" if unit and name else "")


def _verdict(obj: str, entry: dict[str, Any]) -> str:
    parts = []
    for prop, verb in (("weight", "weighs"), ("width", "is"), ("height", "is")):
        if entry.get(prop):
            value = f"{_number(prop, entry[prop]['mean'])} ± {_number(prop, entry[prop]['sd'], unit=True)}"
            parts.append(f"{verb} {value}" + {"weight": "", "width": " wide", "height": " high"}[prop])
    friction = entry.get("friction")
    if friction and friction.get("mean") is not None:
        parts.append(f"has a friction coefficient of {_number('friction', friction['mean'])}")
    elif friction:
        parts.append(f"has a friction coefficient of at least {_number('friction', friction['lower_bound'])}")
    return f"{obj} {', '.join(parts)}." if parts else f"Nothing could be determined of {obj}."


def _rows(body: dict[str, Any], measured: Actual | None) -> list[dict[str, str]]:
    rows = []
    for obj, entries in body["properties"].items():
        for prop, entry in entries.items():
            row = dict.fromkeys(("interval_68", "interval_95", "measured", "deviation"), "")
            row |= {"block": obj, "property": prop, "estimate": "unknown"}
            row["source"] = body["reasons"].get(f"{obj}.{prop}", "")
            value = (measured or {}).get(obj, {}).get(prop)
            if value is not None:
                row["measured"] = _number(prop, value[0], unit=True)
            if entry is not None:
                row["source"] = ", ".join(entry.get("subtasks", ()))
                row["estimate"] = f"≥ {_number(prop, entry['lower_bound'])}" if "lower_bound" in entry else ""
                if entry.get("mean") is not None:
                    row["estimate"] = (
                        f"{_number(prop, entry['mean'])} ± {_number(prop, entry['sd'], unit=True)}"
                    )
                    for key in ("interval_68", "interval_95"):
                        row[key] = " to ".join(_number(prop, v) for v in entry[key])
                    if value is not None:
                        wrong = body.get("actual", {}).get(obj, {}).get(prop, {}).get("disagrees")
                        row["deviation"] = f"{100 * (entry['mean'] / value[0] - 1):+.2f} %" + (
                            ", disagrees" if wrong else ""
                        )
            rows.append(row)
    return rows
