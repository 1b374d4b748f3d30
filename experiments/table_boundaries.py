"""docs/segmentation_results.md from the results of experiments.calibration_boundaries.

python -m experiments.table_boundaries
"""

from __future__ import annotations

import json
from pathlib import Path

from experiments.estimates import KINDS

RESULTS = Path(__file__).parent / "results"
PAGE = Path(__file__).parents[1] / "docs" / "segmentation_results.md"
HEAD = """# Boundaries in worlds that differ

Written by `make boundaries` (`experiments/calibration_boundaries.py` and `table_boundaries.py`): worlds of
`experiments/boundary_worlds.py`, the project's own simulator, single trials of two blocks restacked.
Before: commit {before}, trials from number {before_first} on; now: commit {now}, from {first} on, which it
had not seen.
Error is the median (and 95th percentile) of |found - true|; half width is of the 90 % intervals, which should
cover 86 to 94 %. {trials} trials of 8 boundaries a row, so that a row's coverage is known to about 3 %.
Grips that slip until they lose their block are left out.

| world | misfits before | now | error before [ms] | now | cover before | now | half width now [ms] |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
"""


def row(name: str, before: dict | None, now: dict) -> str:
    """One line of the table."""

    def error(entry: dict | None) -> str:
        every = None if entry is None else entry.get("all")
        return "" if every is None else f"{every['median']:.1f} ({every['percentile_95']:.0f})"

    def cover(entry: dict | None) -> str:
        every = None if entry is None else entry.get("all")
        return "" if every is None else f"{100 * every['coverage_90']:.0f} %"

    width = "" if "all" not in now else f"{now['all']['half_width']:.1f}"
    misfits = "" if before is None else f"{before['misfits']}"
    return (f"| {name} | {misfits} | {now['misfits']} | {error(before)} | {error(now)} | {cover(before)} | "
            f"{cover(now)} | {width} |")  # fmt: skip


KINDS_HEAD = """
By kind of boundary: by what factor intervals would have to be wider to hold 90 % (the 90th percentile of
errors over the median half width), and how many hold. They are widest at 20 Hz for set-downs, in whose
sample interval one motion may end and the next begin, and for releases, which laboratories date in three
ways ([segmentation](segmentation.md)): a recording shows neither, so the prior decides, and the project's
own simulator does only one of each.

| world | touch | lift | land | release |
| --- | ---: | ---: | ---: | ---: |
"""
BY_KIND = ("10 Hz", "20 Hz", "50 Hz", "100 Hz", "1000 Hz")


def kinds_row(name: str, now: dict) -> str:
    """One line of the table by kind."""
    of = [now[kind] for kind in KINDS]
    cells = [f"x{k['percentile_90'] / k['half_width']:.2f} ({100 * k['coverage_90']:.0f} %)" for k in of]
    return f"| {name} | " + " | ".join(cells) + " |"


def main() -> None:
    """Write the page."""
    earlier, latest = (json.loads((RESULTS / f"calibration_boundaries{end}.json").read_text(encoding="utf-8"))
                       for end in ("_before", ""))  # fmt: skip
    before, now = earlier["rows"], latest["rows"]
    trials = max(entry["trials"] for entry in now.values())
    lines = [row(name, before.get(name), entry) for name, entry in now.items()]
    PAGE.write_text(
        HEAD.format(
            trials=trials,
            first=latest["first"],
            before_first=earlier["first"],
            before=earlier["made_by"],
            now=latest["made_by"],
        )
        + "\n".join(lines)
        + "\n"
        + KINDS_HEAD
        + "\n".join(kinds_row(name, now[name]) for name in BY_KIND)
        + "\n",
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
