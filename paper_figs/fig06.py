"""Figure 6: forces on the environment."""

from __future__ import annotations

from hmmseg.plot.style import canvas
from paper_figs.panels import THRESHOLD_HANDLE, forces, name_marks, shade, state_handles
from paper_figs.results import load, target


def main() -> None:
    found = load("recording")
    carries = [s for s in found["spans"] if s["subtask"] == "carry"]
    with canvas(target("fig06"), height=5.4) as figure:
        axes = forces(figure, {"t": found["t"], **found["signals"]})
        for ax in axes:
            shade(ax, found["spans"])
            name_marks(ax, [((s["start"] + s["end"]) / 2, f"g{s['object'][-1]}") for s in carries])
        figure.legend(handles=[*state_handles(), THRESHOLD_HANDLE], loc="outside lower center", ncols=4)


if __name__ == "__main__":
    main()
