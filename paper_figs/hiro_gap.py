"""A snap assembly, real against simulated: forces by subtask, and what rings after the snap."""

from __future__ import annotations

import json

import numpy as np

from hmmseg.plot.style import BLUE, GREY, INK, RED, canvas
from paper_figs.results import ROOT, target

RESULTS = ROOT / "experiments" / "results" / "hiro_gap.json"
SUBTASKS = ("approach", "rotation", "insertion", "mating")
UNITS = {"fx": "N", "fz": "N", "my": "N m"}


def main() -> None:
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    with canvas(target("hiro_gap"), height=5.6) as figure:
        grid = figure.subplots(2, 3)
        for axes, (name, course) in zip(grid[0], found["figure"]["course"].items(), strict=True):
            subtask = np.array(course["subtask"])
            x = np.concatenate(
                [
                    k + (np.arange((subtask == k).sum()) + 0.5) / (subtask == k).sum()
                    for k in range(len(SUBTASKS))
                ]
            )
            for kind, colour, label in (("real", RED, "real"), ("sim", BLUE, "simulated")):
                mean, sd = np.array(course[kind]), np.array(course[f"{kind}_sd"])
                axes.fill_between(x, mean - sd, mean + sd, color=colour, alpha=0.25, lw=0)
                axes.plot(x, mean, color=colour, label=label)
            axes.plot(x, course["explained"], color=INK, lw=0.8, ls="--", label="simulated + what was found")
            for edge in range(1, len(SUBTASKS)):
                axes.axvline(edge, color=GREY, lw=0.5)
            axes.set_xticks(np.arange(len(SUBTASKS)) + 0.5, SUBTASKS, fontsize=6.5)
            axes.set_ylabel(f"{name} [{UNITS[name]}]")
        grid[0, 0].legend(fontsize=6, loc="upper left")
        grid[0, 1].set_title("Course of each subtask (mean and scatter between trials)")
        tails, step = found["figure"]["tails"], found["figure"]["tails"]["step"]
        ring = found["ringing"]["fz"]["after_the_snap"]
        for axes, kind, colour in ((grid[1, 0], "real", RED), (grid[1, 1], "sim", BLUE)):
            mean, sd = np.array(tails[kind]), np.array(tails[f"{kind}_sd"])
            at = np.arange(mean.size) * step
            axes.fill_between(at, mean - sd, mean + sd, color=colour, alpha=0.25, lw=0)
            axes.plot(at, mean, color=colour)
            axes.set(xlabel="time since the last start [s]", ylabel="fz [N]", ylim=(5, 46), xlim=(0, 3))
        low, high = ring["frequency_90"]
        grid[1, 0].set_title(f"Real: rings at {ring['frequency']:.2f} Hz ({low:.2f}-{high:.2f})")
        grid[1, 1].set_title("Simulated: the tail ends")
        bars = grid[1, 2]
        names = list(found["ringing"])[:3]
        for place, (band, hatch) in enumerate((("2.6 Hz", ""), ("7-8 Hz", "//"))):
            for shift, kind, colour in ((-0.2, "rms_real", RED), (0.2, "rms_sim", BLUE)):
                values = [found["ringing"][n][band][kind] for n in names]
                bars.bar(np.arange(3) + 4 * place + shift, values, 0.4, color=colour, hatch=hatch)
        bars.set_yscale("log")
        bars.set_xticks([0, 1, 2, 4, 5, 6], names * 2)
        bars.set_ylabel("rms in the first 0.95 s [N]")
        bars.set_title("1.5-4 Hz; hatched: 6.5-8.5 Hz")


if __name__ == "__main__":
    main()
