"""Render docs/reproduction.md from the saved results.

python -m experiments.paper.write_docs
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from experiments.paper.sources import BLOCKS, TRIALS
from paper_figs.results import ROOT, load

TEMPLATE = "reproduction.md.j2"
TARGET = ROOT / "docs" / "reproduction.md"
FORMULAS = {
    "weight": ("mean of fy1 + fy2, first and last 5 % left out", "fy1 + fy2 = weight (1 + a / g)"),
    "height": ("difference of the means of y2 (absolute)", "rise = height, the pads' shear taken out"),
    "width": ("mean of x2 − x1", "x2 − x1 + (fx1 − fx2) / k = width, k the pads' stiffness"),
    "friction": ("largest of abs(fy1 / fx1), a lower bound", "largest true ratio in firm grips"),
}  # fmt: skip


def measured(value: list[float], factor: float, digits: int) -> str:
    """Value and sd as printed; an sd below the digits gets those it needs."""
    mean, sd = value[0] * factor, value[1] * factor
    places = max(digits, -math.floor(math.log10(sd))) if sd > 0 else digits
    return f"{mean:.{digits}f} ± {sd:.{places}f}"


def estimate(found: dict[str, Any], factor: float) -> str:
    """Mean and sd with two digits of the sd."""
    sd = found["sd"] * factor
    places = max(0, 1 - math.floor(math.log10(sd)))
    return f"{found['mean'] * factor:.{places}f} ± {sd:.{places}f}"


def plusminus(found: dict[str, Any], factor: float, digits: int) -> str:
    """Mean and sd with given digits."""
    return f"{found['mean'] * factor:.{digits}f} ± {found['sd'] * factor:.{digits}f}"


def percent(value: float, digits: int) -> str:
    """A share in percent."""
    return f"{100 * value:.{digits}f} %"


def fixed(value: float, digits: int) -> str:
    """A number with the given decimals."""
    return f"{value:.{digits}f}"


def signed(value: float, digits: int) -> str:
    """A number with its sign."""
    return f"{value:+.{digits}f}".replace("-", "−")


def covered(entry: dict[str, Any]) -> str:
    """Share covered with its interval."""
    low, high = (100 * end for end in entry["interval_95"])
    return f"{percent(entry['share'], 0)} ({low:.0f} to {high:.0f}) of {entry['count']}"


def average(rows: list[dict[str, Any]], key: str) -> float:
    """Mean over rows of one entry."""
    return float(np.mean([row[key] for row in rows]))


def worst(table: dict[str, Any]) -> dict[str, dict[str, str]]:
    """Largest relative deviation of the paper's method from the actual values, over both blocks."""
    out: dict[str, dict[str, str]] = {}
    for which in ("one", "all"):
        found, out[f"paper_{which}"] = table["recordings"]["paper"][which], {}
        for key in ("weight", "width", "height"):
            largest = max(abs(found[b][key]["mean"] / table["actual"][b][key][0] - 1) for b in BLOCKS)
            out[f"paper_{which}"][key] = percent(largest, 1)
    return out


def misses(alike: dict[str, Any]) -> list[str]:
    """Coverages whose interval does not hold the nominal share."""
    out = []
    for source, scores in alike.items():
        for key, entry in scores["hmm"]["coverage"].items():
            if not entry["holds"]:
                kind = "wider than need be" if entry["share"] > entry["nominal"] else "too narrow"
                out.append(f"{key} of the {source}: intervals {kind}")
    return out


def render() -> str:
    """The whole page."""
    names = ("tables", "states", "recording", "estimates", "rigid", "slip", "replay", "alike", "alignments")
    results = {name: load(name) for name in names}
    table4 = results["estimates"]["table_4"]
    performed = [row["friction"] for row in results["slip"]["performed"]]
    filters = (measured, estimate, plusminus, percent, fixed, signed, covered, average)
    environment = Environment(loader=FileSystemLoader(Path(__file__).parent), undefined=StrictUndefined,
                              trim_blocks=False, keep_trailing_newline=True)  # fmt: skip
    environment.filters |= {f.__name__: f for f in filters}
    return environment.get_template(TEMPLATE).render(
        **results, virtual=load("virtual_block"), table4=table4, simulated=TRIALS, formulas=FORMULAS,
        file=results["recording"]["file"], worst=worst(table4), misses=misses(results["alike"]),
        performed_friction=(max(performed), min(performed)),
    )  # fmt: skip


def main() -> None:
    """Write the page."""
    TARGET.write_text(render(), encoding="utf-8")


if __name__ == "__main__":
    main()
