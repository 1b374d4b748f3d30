"""Draw every figure of the paper's reproduction from saved results.

python -m paper_figs [NAME...]
"""

from __future__ import annotations

import argparse
import importlib

FIGURES = (
    "fig03",
    "fig05",
    "fig06",
    "fig07",
    "fig08",
    "fig09",
    "fig11",
    "fig12",
    "fig13",
    "fig14",
    "table4",
    "rigid",
    "slip",
    "replay",
    "corner",
    "alignments",
    "prior_posterior",
)


def main() -> None:
    """Draw the figures named, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figures", nargs="*", metavar="NAME", help=", ".join(FIGURES))
    names = parser.parse_args().figures or FIGURES
    for name in names:
        if name not in FIGURES:
            parser.error(f"{name!r} is none of {', '.join(FIGURES)}")
        importlib.import_module(f"paper_figs.{name}").main()


if __name__ == "__main__":
    main()
