"""What the pages share: templates, and figures inside."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import jinja2

import hmmseg


def rendered(template: str, **values: Any) -> str:
    """A page of the templates' folder; a name that it lacks is an error."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template(template).render(version=hmmseg.__version__, **values)


def embedded(path: Path) -> str:
    """A PNG as a data URL."""
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
