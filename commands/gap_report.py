"""The page of a diagnosis: one self-contained HTML file, written like an engineer's finding."""

from __future__ import annotations

import base64
import tempfile
from pathlib import Path
from typing import Any

import jinja2

from commands.figures.gap import draw_all
from simgap.effects import catalogue
from simgap.gap.diagnose import Diagnosis

TEMPLATE = Path(__file__).with_name("gap_report.html")


def page(found: Diagnosis, sentence: str, measured: dict | None) -> str:
    """The page as text; figures are drawn and embedded."""
    body = found.body
    with tempfile.TemporaryDirectory(prefix="hmmseg-") as folder:
        draw_all(found, lambda name: Path(folder) / name)
        images = {p.stem: _embedded(p) for p in Path(folder).iterdir()}
    flat = {f"{o}.{k}": f"{v[0]:.5g}" for o, entries in (measured or {}).items() for k, v in entries.items()}
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        body=body,
        sentence=sentence,
        images=images,
        files=found.problem.frame.files,
        warnings=found.warnings,
        suspects=_suspects(body),
        effect=body["effects"].get("+".join(body["causes"])),
        measured=flat,
    )


def _suspects(body: dict[str, Any]) -> list[dict[str, Any]]:
    known = catalogue()
    return [
        {
            "name": name,
            "probability": body["probabilities"].get(name, 0.0),
            "evidence": e["log_evidence"],
            "heldout": e["heldout_score"],
            "shows": "; ".join(known[n].shows for n in name.split("+")),
        }
        for name, e in body["effects"].items()
    ]


def _embedded(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
