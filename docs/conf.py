"""The documentation site: `make docs` builds it into build/docs, warnings as errors."""

from __future__ import annotations

import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import hmmseg  # noqa: E402

project = "hmmseg"
author = "The hmmseg developers"
release = version = hmmseg.__version__
copyright = author

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 4
default_role = "code"
exclude_patterns = ["README.md"]

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_preserve_defaults = True

highlight_language = "none"
html_theme = "furo"
html_title = f"hmmseg {version}"
html_static_path: list[str] = []
html_show_copyright = False
html_theme_options = {"navigation_with_keys": True}


def _more(app, docname: str, source: list[str]) -> None:
    """Pages that the index lists nowhere stand at its end, so that none is out of reach."""
    if docname != "index":
        return
    listed = {line.strip() for line in source[0].splitlines()}
    pages = sorted(path.stem for path in Path(app.srcdir).glob("*.md"))
    source[0] = source[0].replace("@more@", "\n".join(p for p in pages if p not in listed and p != "index"))


def _as_rst(app, what, name, obj, options, lines: list[str]) -> None:
    """Blocks of code in docstrings, indented by four after an empty line, as reStructuredText has them."""
    out: list[str] = []
    for line in lines:
        indented = line.startswith("    ")
        before = next((each for each in reversed(out) if each.strip()), "")
        if indented and out and not out[-1].strip() and not before.startswith((" ", ">>>", "-", "::")):
            out += ["::", ""]
        out.append(line)
    lines[:] = out


def setup(app) -> None:
    """What Sphinx calls."""
    app.connect("source-read", _more)
    app.connect("autodoc-process-docstring", _as_rst)
