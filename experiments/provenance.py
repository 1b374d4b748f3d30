"""Which make target makes which figure and table of the pages anew (docs/architecture.md)."""

from __future__ import annotations

from collections.abc import Iterable

from experiments.table_text import markdown

# Figures of docs/figures, by the make target that draws them.
FIGURES = {
    "paper": (
        "fig03", "fig05", "fig06", "fig07", "fig08", "fig09", "fig11", "fig12", "fig13", "fig14", "table4",
        "rigid", "slip", "replay", "corner", "alignments", "prior_posterior",
    ),
    "sweeps": ("sweep_plane", "sweep_lines", "sweep_coverage"),
    "calibrate": ("sbc", "calibration_worlds"),
    "bench": ("benchmarks",),
    "bench-long": ("long_recordings",),
    "sequences": ("sequences",),
    "bench-watch": ("watch_lag",),
    "blind-check": ("gap_reliability",),
    "real": (
        "hiro_gap", "way_eeg_gal", "xl330_signal", "xl330_before_after",
        "contactnets", "collins_push", "so101_signal", "so101_before_after",
    ),
    "readme-figures": ("demo_segments", "play"),
}  # fmt: skip
# Pages whose tables a script of their own writes, by its target.
PAGES_OF = {
    "boundaries": "segmentation_results",
    "constants": "constants",
    "paper": "reproduction",
    "sweeps": "sweeps",
}


def table(tables: Iterable[tuple[str, str, str]]) -> str:
    """Targets with what they make; `tables`: page, name and target of each."""
    made: dict[str, list[str]] = {}
    for page, name, target in tables:
        made.setdefault(target, []).append(f"{page.removeprefix('docs/')} ({name.replace('_', ' ')})")
    for target, page in PAGES_OF.items():
        made.setdefault(target, []).append(f"{page}.md")
    rows = []
    for target in sorted(made.keys() | FIGURES.keys()):
        figures = ", ".join(FIGURES.get(target, ()))
        rows.append([f"`make {target}`", ", ".join(made.get(target, ())), figures])
    return markdown(["target", "tables", "figures"], rows)
