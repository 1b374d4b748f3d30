"""Draw every figure of the paper's reproduction, and that of the blind check, from saved results.

python -m paper_figs [NAME...]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

from paper_figs import properties, recording, virtual_block
from paper_figs.gap_reliability import gap_reliability

DRAWN: tuple[Callable[[], None], ...] = (
    recording.fig03, recording.fig05, recording.fig06, recording.fig07, recording.fig08, recording.fig09,
    virtual_block.fig11, virtual_block.fig12, virtual_block.fig13, virtual_block.fig14, virtual_block.replay,
    properties.table4, properties.rigid, properties.slip, properties.corner, properties.prior_posterior,
    recording.alignments, gap_reliability,
)  # fmt: skip
FIGURES = {draw.__name__: draw for draw in DRAWN}


def main() -> None:
    """Draw the figures named, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("figures", nargs="*", metavar="NAME", help=", ".join(FIGURES))
    names = parser.parse_args().figures or FIGURES
    for name in names:
        if name not in FIGURES:
            parser.error(f"{name!r} is none of {', '.join(FIGURES)}")
        FIGURES[name]()


if __name__ == "__main__":
    main()
