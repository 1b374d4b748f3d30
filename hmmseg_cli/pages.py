"""Pages of `--report`: one self-contained HTML file each, with its figures."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2

import hmmseg
from estimation.identification import Identification
from estimation.plots import draw_check, draw_corner, draw_estimates
from estimation.report import INTERVALS, Actual, property_rows
from hmmseg.io.trial import Trial
from hmmseg.numbers import SHOWN, between, estimate, interval, percent, plain, property_shown_as, shown_as
from hmmseg.segmentation.spans import Segmentation
from simgap.report import finding
from simgap.report.finding import plain_name

if TYPE_CHECKING:
    from simgap.report.robot import Own


def rendered(template: str, **values: Any) -> str:
    """A page from the templates' folder; a name that is undefined in it is an error."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template(template).render(version=hmmseg.__version__, **values)


def embedded(draw: Callable[[Callable[[str], Path]], Any]) -> dict[str, str]:
    """PNGs as data URLs, by stem; `draw` gets a function from a file name to the path to draw at."""
    with tempfile.TemporaryDirectory(prefix="hmmseg_") as folder:
        draw(lambda name: Path(folder) / name)
        return {
            p.stem: "data:image/png;base64," + base64.b64encode(p.read_bytes()).decode()
            for p in sorted(Path(folder).iterdir())
        }


def _picture(draw: Callable[..., Any], caption: str, *args: Any, **more: Any) -> dict[str, str]:
    """A figure with its caption; `draw` takes the path as its last positional argument."""
    (data,) = embedded(lambda path: draw(*args, path("figure.png"), **more)).values()
    return {"data": data, "caption": caption}


def identification_page(
    trials: Sequence[Trial], segmentations: Sequence[Segmentation], body: dict[str, Any],
    found: Identification | None, measured: Actual | None, warnings: Sequence[str],
) -> str:  # fmt: skip
    """HTML page of one identification."""
    what = "Estimates with 68 and 95 % intervals"
    figures = [_picture(draw_estimates, what, body["properties"], measured)]
    if found is not None and found.names:
        drawn = found.draws, found.names
        figures.append(_picture(draw_corner, "Posterior of all properties", *drawn, actual=measured))
    shown = []
    for i, (trial, segmentation) in enumerate(zip(trials, segmentations, strict=True)):
        pictures = [_picture(segmentation.plot, "Signals with subtasks and boundaries")]
        if found is not None:
            pictures.append(_picture(draw_check, "Recorded samples in their predicted bands", found, i))
        evidence = segmentation.log_evidence
        spans = [
            (s.label, s.state, f"{s.start:.3f}",
             f"{s.start_90[0]:.3f} to {s.start_90[1]:.3f}" if s.start_sd else "", f"{s.end:.3f}")
            for s in segmentation.spans
        ]  # fmt: skip
        shown.append({
            "name": trial.name, "rate": f"{segmentation.rate:.4g}", "complete": segmentation.complete,
            "log_evidence": "none" if evidence is None else f"{evidence:.1f}", "figures": pictures,
            "spans": spans,
        })  # fmt: skip
    checks = [
        (name, plain(check["p_value"], 2),
         estimate(check["scatter_between_grips"], 0, shown_as("N" if name == "force" else "m")))
        for name, check in (body.get("predictive") or {}).items()
    ]  # fmt: skip
    apart = ("measured", "deviation") if measured is not None else ()
    keys = ("block", "property", "estimate", *INTERVALS, *apart, "from")
    return rendered(
        "identify.html.j2", method=body["method"], objects=list(body["properties"]),
        verdict=[_verdict(obj, entry) for obj, entry in body["properties"].items()],
        warnings=warnings, measured=measured is not None, figures=figures,
        rows=[[row[key] for key in keys] for row in property_rows(body, measured)],
        trials=shown, sampler=body["sampler"], predictive=checks, notes=body.get("notes", ()),
    )  # fmt: skip


def _verdict(obj: str, entry: dict[str, Any]) -> str:
    parts = []
    for prop, text in (("weight", "weighs {}"), ("width", "is {} wide"), ("height", "is {} high")):
        if entry.get(prop):
            parts.append(text.format(estimate(entry[prop]["mean"], entry[prop]["sd"], SHOWN[prop])))
    friction = entry.get("friction")
    if friction and friction.get("mean") is not None:
        parts.append(f"has a friction coefficient of {estimate(friction['mean'], friction['sd'])}")
    elif friction:
        parts.append(f"has a friction coefficient of at least {plain(friction['lower_bound'])}")
    return f"{obj} {', '.join(parts)}." if parts else f"Nothing could be determined of {obj}."


Body = Mapping[str, Any]
MOST = 8  # look: rows of a table
NOTHING = 5e-3  # look: probability, or share of a gap, below which it is shown as none
SHARES = ("gain", "scale", "finger1", "finger2", "fx1", "fy1", "fx2", "fy2")  # in per cent if dimensionless


@dataclass(frozen=True)
class Setting:
    """Contents of a page apart from the body."""

    files: Sequence[str]  # recordings
    rig: Mapping[str, Any] = field(default_factory=dict)  # its pads
    # independent values of properties
    measured: Mapping[str, Mapping[str, tuple[float, float]]] | None = None
    shows: Mapping[str, str] = field(default_factory=dict)  # signature of each effect
    warnings: Sequence[str] = ()
    # by part of a robot, the unit in which its logs give a quantity
    own: Mapping[str, Own] = field(default_factory=dict)
    motion: str = ""  # place of the motion to run next


def page(body: Body, setting: Setting, draw: Callable[[Callable[[str], Path]], None]) -> str:
    """HTML page of one diagnosis; `draw(path)` draws figures at path(name.png), which are embedded."""
    images = embedded(draw)
    effect = body["effects"].get("+".join(body["causes"]))
    fitted = (body.get("calibrated") or {}).get("parameters") or {}
    cells, measured = finding.by_place(body), setting.measured
    to_do = [*finding.to_do(body), *filter(None, [finding.settles(body, measured is not None)])]
    return rendered(
        "diagnose.html.j2", headline=finding.headline(body, setting.rig), lines=finding.sentences(body),
        to_do=to_do if body["verdict"] != "none" else [], remains=finding.remains(body),
        parameters=_parameters(effect, body["causes"], setting) if effect and body["causes"] else [],
        where=[_place(key, found) for key, found in list(cells.items())[:MOST]],
        more_cells=max(len(cells) - MOST, 0),
        images=dict.fromkeys(("gap_where", "gap_signal", "gap_before_after")) | images,
        suspects=_suspects(body, setting), attributed=bool(body.get("attribution")),
        robot="numerics" in body, compared="changes" in body, motion=setting.motion,
        calibrated=[(plain_name(n), *_values(n, p, shown_as(p["unit"]), setting)) for n, p in fitted.items()],
        properties=_properties(effect, measured) if effect and body["causes"] else [],
        measured=measured is not None, numerics=_numerics(body), detection=_detection(body), far=_far(body),
        warnings=setting.warnings, files=setting.files,
    )  # fmt: skip


def _place(key: tuple[str, str], cells: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    lows, highs = [c["band"][0] for c in cells], [c["band"][1] for c in cells]
    band = f"{min(lows):g} to {max(highs):g}" if None not in highs else ""
    scores = [c["z"] for c in cells if c["z"] is not None]
    score, trials = f"{max(scores):.0f}" if scores else "", str(len({c["trial"] for c in cells}))
    return (*key, percent(finding.share_of(cells)), score, trials, band)


def _parameters(effect: Mapping[str, Any], causes: Sequence[str], setting: Setting) -> list[tuple[str, ...]]:
    """Rows of the parameter, the model's value if known, the estimate and its interval."""
    rows = list[tuple[str, ...]]()
    for name, p in effect["parameters"].items():
        cause = next((c for c in causes if name.startswith(f"{c}.")), causes[0])
        last = name.rpartition(".")[2]
        shown = SHOWN[last] if last in SHOWN else shown_as(p["unit"], share=last in SHARES)
        words = last.replace("_", " ")
        if p.get("nominal") is not None:
            words = plain_name(cause) + (f", {words}" if not cause.endswith(f".{last}") else "")
        if cause.endswith(".payload") and (where := setting.shows.get(cause, "").partition(", ")[2]):
            words += f" {where}"
        rows.append((words, *_values(cause, p, shown, setting)))
    return rows


def _values(
    name: str, p: Mapping[str, Any], shown: tuple[float, str], setting: Setting
) -> tuple[str, str, str]:
    """The model's value, the estimate and its interval, each also in its column's own unit if it has one."""
    part, _, last = name.rpartition(".")
    own = setting.own.get(part, setting.own.get(part.partition(":")[2]))
    both = [shown]
    if own is not None and own.si == p["unit"] and (own.offset == 0 or last == "bias"):
        both.insert(0, (1 / own.factor, own.unit))

    def in_both(write: Callable[[tuple[float, str]], str]) -> str:
        first, *rest = map(write, both)
        return first + "".join(f" ({text})" for text in rest)

    model = "" if p.get("nominal") is None else in_both(lambda u: estimate(p["nominal"], 0.0, u))
    if p["mean"] is None:
        return model, "not determined by these logs", ""
    low, high = p["interval_90"] or (None, None)
    ends = "" if low is None or high is None else in_both(lambda u: interval(low, high, u))
    return model, in_both(lambda u: estimate(p["mean"], p["sd"] or 0.0, u)), ends


def _numerics(body: Body) -> str:
    """The simulation's own time step and the hold of commands, in one sentence."""
    known = {
        "option.timestep": "the error of the solver's step by {:+.0%}",
        "option.integrator": "{:.0%} of another integrator's error",
        "option.late": "commands come {:.2f} of the simulator's step late",
        "option.smooth": "{:.0%} of each command is the mean of those before and after it",
        "option.hold": "commands are held {:.0%} of the way from a step to a line",
    }
    parts = [
        text.format(abs(v["after"]) if name == "option.hold" else v["after"])
        for name, text in known.items()
        if (v := (body.get("numerics") or {}).get(name)) and abs(v["after"]) > 0.05
    ]
    return f"Fitted as well, and never a cause: {'; '.join(parts)}." if parts else ""


def _suspects(body: Body, setting: Setting) -> list[tuple[str, ...]]:
    """Rows of all candidates: probability, share of the gap, and where the effect would show."""
    attribution = body.get("attribution") or {}
    rows = list[tuple[str, ...]]()
    for name, chance in sorted(finding.chances(body).items(), key=lambda row: -row[1])[:MOST]:
        own, share = attribution.get(name), ""
        idle = own and own.get("share") is not None and own["share"] < NOTHING
        if name not in body["causes"] and (chance < NOTHING or idle):
            continue  # explains nothing, even if it is compatible with the rest
        if own and own.get("share") is not None and own["probability"] >= 0.01:
            ends = between(*(own.get("interval_90") or (None, None)))
            share = percent(own["share"]) + (f" ({ends})" if ends else "")
        shows = "; ".join(setting.shows[n] for n in name.split("+") if n in setting.shows)
        rows.append((plain_name(name), percent(chance), share, shows, name))
    return rows


def _properties(effect: Mapping[str, Any], measured: Mapping[str, Any] | None) -> list[tuple[str, ...]]:
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
    text = f"A healthy recording of this rig and task differs from it as much with {finding.p_text(p)}"
    if "changes" in body:
        text = f"Logs of a robot that did not change differ as much with {finding.p_text(p)}"
    elif "numerics" in body:
        text = f"Logs of a robot that is as its model differ from it as much with {finding.p_text(p)}"
    if not fineness:
        return f"{text}."
    others = round(1 / fineness) - 1
    few = "one healthy set" if others == 1 else f"{others} healthy sets"
    return f"{text}. This follows from the sensors' noise: a rank among {few} shows {fineness:.2g} at least."


def _far(body: Body) -> str:
    s = body.get("shrinkage")
    if not s or s.get("fraction") is None or s.get("before") is None:
        return ""
    fall = f"from {plain(s['before'])} to {plain(s['after'])}"
    if "changes" in body:
        rest = f"old ones leave {plain(s['noise_floor'])}"
        return f"On {s['evaluated_on']} what is missed falls {fall} nats a row; {rest}."
    text = (f"On {s['evaluated_on']} the mean squared residual falls {fall}; "
            f"healthy recordings leave {plain(s['noise_floor'])}.")  # fmt: skip
    if s.get("flexible_ceiling") is not None:
        text += f" A description free of any physics would take {percent(s['flexible_ceiling'])} of the gap."
    return text
