"""The page of a diagnosis: one self-contained HTML file, written from its JSON for who must act on it."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hmmseg.numbers import SHOWN, between, estimate, interval, percent, plain, property_shown_as, shown_as
from hmmseg_cli.pages import embedded, rendered
from simgap.report import finding
from simgap.report.causes import plain_name

Body = Mapping[str, Any]
MOST = 8  # look: rows of a table
SHARES = (
    "gain",
    "scale",
    "finger1",
    "finger2",
    "fx1",
    "fy1",
    "fx2",
    "fy2",
)  # shown in per cent if in no unit


@dataclass(frozen=True)
class Setting:
    """What a page tells beside the body: recordings, subtasks in order, the rig's pads, what was measured,
    and how each effect would show.
    """

    files: Sequence[str]
    subtasks: Sequence[str]
    rig: Mapping[str, Any] = field(default_factory=dict)
    measured: Mapping[str, Mapping[str, tuple[float, float]]] | None = None
    shows: Mapping[str, str] = field(default_factory=dict)
    warnings: Sequence[str] = ()


def page(body: Body, setting: Setting, draw: Callable[[Callable[[str], Path]], None]) -> str:
    """The page as text; `draw(path)` draws figures at path(name.png), which are embedded."""
    with tempfile.TemporaryDirectory(prefix="hmmseg-") as folder:
        draw(lambda name: Path(folder) / name)
        images = {p.stem: embedded(p) for p in sorted(Path(folder).iterdir())}
    effect = body["effects"].get("+".join(body["causes"]))
    cells = finding.by_place(body)
    return rendered(
        "diagnose.html.j2",
        headline=finding.headline(body, setting.rig),
        lines=finding.sentences(body),
        to_do=finding.to_do(body) if body["verdict"] != "none" else [],
        remains=finding.remains(body),
        parameters=_parameters(effect) if effect and body["causes"] else [],
        subtasks=setting.subtasks,
        heat=_heat(cells, setting.subtasks) if cells else [],
        where=[_place(key, found) for key, found in list(cells.items())[:MOST]],
        more_cells=max(len(cells) - MOST, 0),
        images=images | {n: None for n in ("gap_signal", "gap_before_after") if n not in images},
        suspects=_suspects(body, setting),
        attributed=bool(body.get("attribution")),
        properties=_properties(effect, setting.measured) if effect and body["causes"] else [],
        measured=setting.measured is not None,
        detection=_detection(body),
        far=_far(body),
        warnings=setting.warnings,
        files=setting.files,
    )


def _heat(cells: Mapping[tuple[str, str], Sequence], subtasks: Sequence[str]) -> list[dict[str, Any]]:
    channels = [c for c in finding.CHANNELS if any(k[0] == c for k in cells)]
    channels += sorted({k[0] for k in cells} - set(channels))
    top = max(finding.share_of(found) for found in cells.values())
    out = []
    for channel in channels:
        row: list[dict[str, str] | None] = []
        for subtask in subtasks:
            found = cells.get((channel, subtask))
            row.append(_coloured(finding.share_of(found), top) if found else None)
        out.append({"name": channel, "cells": row})
    return out


def _coloured(share: float, top: float) -> dict[str, str]:
    depth = (share / top) ** 0.5 if top > 0 else 0.0
    light = 94 - 50 * depth
    text = "<1" if share < 0.005 else f"{100 * share:.0f}"
    return {"colour": f"hsl(24 90% {light:.0f}%)", "ink": "#fff" if light < 58 else "#3a1d00", "text": text}


def _place(key: tuple[str, str], cells: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    lows, highs = [c["band"][0] for c in cells], [c["band"][1] for c in cells]
    band = f"{min(lows):g} to {max(highs):g}" if None not in highs else ""
    scores = [c["z"] for c in cells if c["z"] is not None]
    trials = str(len({c["trial"] for c in cells}))
    return (
        key[0],
        key[1],
        percent(finding.share_of(cells)),
        f"{max(scores):.0f}" if scores else "",
        trials,
        band,
    )


def _parameters(effect: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    rows = []
    for name, p in effect["parameters"].items():
        last = name.rpartition(".")[2]
        shown = SHOWN[last] if last in SHOWN else shown_as(p["unit"], share=last in SHARES)
        low, high = p["interval_90"]
        ends = "" if None in (low, high) else interval(low, high, shown)
        rows.append((name.replace("_", " "), estimate(p["mean"], p["sd"] or 0.0, shown), ends))
    return rows


def _suspects(body: Body, setting: Setting) -> list[tuple[str, ...]]:
    """Every effect that was looked at: whether it acts, what it explains, its evidence and signature."""
    attribution = body.get("attribution") or {}
    names = dict.fromkeys([*attribution, *body["effects"]])
    rows = []
    for name in names:
        entry, own = body["effects"].get(name), attribution.get(name)
        acts = own["probability"] if own else body["probabilities"].get(name)
        share = ""
        if own and own.get("share") is not None and own["probability"] >= 0.01:
            ends = between(*(own.get("interval_90") or (None, None)))
            share = percent(own["share"]) + (f" ({ends})" if ends else "")
        evidence = "" if entry is None or entry["log_evidence"] is None else f"{entry['log_evidence']:.0f}"
        shows = "; ".join(setting.shows[n] for n in name.split("+") if n in setting.shows)
        rows.append(
            (acts or 0.0, (f"{plain_name(name)} ({name})", percent(acts or 0.0), share, evidence, shows))
        )
    rows.sort(key=lambda row: -row[0])
    return [row for _, row in rows][:MOST]


def _properties(effect: Mapping[str, Any], measured: Mapping | None) -> list[tuple[str, ...]]:
    rows = []
    for name, shift in (effect.get("property_shift") or {}).items():
        block, _, prop = name.rpartition(".")
        factor, unit = property_shown_as(name, shift["unit"])
        cells = [f"{shift[k] * factor:.4f} {unit}".rstrip() for k in ("before", "after")]
        if measured is not None:
            value = measured.get(block, {}).get(prop)
            cells.append("" if value is None else estimate(value[0], value[1], (factor, unit)))
        rows.append((name, *cells))
    return rows


def _detection(body: Body) -> str:
    p, fineness = body["detection"]["p_value"], body["detection"].get("resolution")
    text = f"A healthy recording of this rig and task differs from the model as much with {finding.p_text(p)}"
    if not fineness:
        return f"{text}."
    return f"{text}; the healthy twins simulated cannot show less than {plain(fineness, 1)}."


def _far(body: Body) -> str:
    s = body.get("shrinkage")
    if not s or s.get("fraction") is None or s.get("before") is None:
        return ""
    fall = f"from {plain(s['before'])} to {plain(s['after'])}"
    text = (
        f"On {s['evaluated_on']} the mean squared residual falls {fall}; "
        f"healthy recordings leave {plain(s['noise_floor'])}."
    )
    if s.get("flexible_ceiling") is not None:
        text += f" A description free of any physics would take {percent(s['flexible_ceiling'])} of the gap."
    return text
