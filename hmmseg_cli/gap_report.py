"""The page of a diagnosis: one self-contained HTML file, written like an engineer's finding."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2

from hmmseg_cli.figures.gap import draw_all
from simgap.effects import catalogue
from simgap.gap.diagnose import Diagnosis

if TYPE_CHECKING:
    from simgap.generic.diagnose import GenericDiagnosis

TEMPLATE = Path(__file__).with_name("gap_report.html")


def page(found: Diagnosis, sentence: str, cells: str, measured: dict | None) -> str:
    """The page as text, `cells` over the table of cells; figures are drawn and embedded."""
    shows = {name: effect.shows for name, effect in catalogue().items()}
    return rendered(found, sentence, cells, measured, draw_all, found.problem.frame.files, shows)


def generic_page(found: GenericDiagnosis, sentence: str, cells: str) -> str:
    """The page of a diagnosis against given simulated trials."""
    from hmmseg_cli.figures.gap_generic import draw_all as draw
    from simgap.generic.effects import CANDIDATES

    files = [cut.trial.name for cut in found.scene.layout.ensembles.real]
    shows = {name: candidate.shows for name, candidate in CANDIDATES.items()}
    return rendered(found, sentence, cells, None, draw, files, shows)


def rendered(
    found: Any,
    sentence: str,
    cells: str,
    measured: dict | None,
    draw: Callable,
    files: Sequence[str],
    shows: dict[str, str],
) -> str:
    """The page of either kind of diagnosis; `shows` says where each effect would show."""
    body = found.body
    with tempfile.TemporaryDirectory(prefix="hmmseg-") as folder:
        draw(found, lambda name: Path(folder) / name)
        images = {p.stem: _embedded(p) for p in Path(folder).iterdir()}
    flat = {f"{o}.{k}": f"{v[0]:.5g}" for o, entries in (measured or {}).items() for k, v in entries.items()}
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        body=body,
        sentence=sentence,
        cells=cells,
        images=images,
        files=files,
        warnings=found.warnings,
        suspects=_suspects(body, shows),
        effect=body["effects"].get("+".join(body["causes"])),
        measured=flat,
    )


def _suspects(body: dict[str, Any], shows: dict[str, str]) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "probability": body["probabilities"].get(name, 0.0),
            "evidence": e["log_evidence"],
            "heldout": e["heldout_score"],
            "shows": "; ".join(shows[n] for n in name.split("+")),
        }
        for name, e in body["effects"].items()
    ]


def _embedded(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
