"""Are the uncertainties true? Boundaries and properties against the truth of many cases.

    python -m experiments.calibration [RECORDINGS] [--cases 64]

On a bank of simulated healthy cases, on the same with hands that deviate as a [systematic] table
says, and on the healthy cases of a recordings folder: all trials of a case pooled (four at a time)
and single trials. Writes experiments/results/calibration.json; docs/calibration.md reads it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

from experiments.estimates import estimate, summarise_estimates
from experiments.recordings import Case, list_cases, read_case
from experiments.saving import save
from experiments.worlds import SEED, simulated_cases
from hmmseg.io.rig import Systematic

RESULTS = Path(__file__).parent / "results"
POOLED = 4
# A hand as a careful lab would calibrate it.
SYSTEMATIC = Systematic(
    force_bias=(0.01,) * 4, force_gain=(0.01,) * 4, joint_offset=(0.001,) * 4,
    link_length=(0.001,) * 4, pad_stiffness=(0.1, 0.1),
)  # fmt: skip


def groups(case: Case, size: int) -> list[slice]:
    """Slices of `size` trials each; trials left over are not used."""
    return [slice(k, k + size) for k in range(0, len(case.trials) - size + 1, size)]


def calibrate(cases: Sequence[Case], pooled: int = POOLED, singles: int | None = None) -> dict:
    """Summaries of all trials pooled and of single trials (the first `singles` of each case)."""
    began = time.perf_counter()
    many = [[estimate(case, g) for g in groups(case, pooled)] for case in cases]
    one = [[estimate(case, g) for g in groups(case, 1)[:singles]] for case in cases]
    return {
        "pooled": summarise_estimates(many), "single": summarise_estimates(one),
        "seconds": time.perf_counter() - began,
    }  # fmt: skip


def report(name: str, found: dict) -> None:
    """One line for each of pooled and single trials."""
    for kind in ("pooled", "single"):
        b, p = found[kind]["boundaries"]["all"], found[kind]["properties"]["all"]
        print(
            f"{name}, {kind}: boundaries median {1e3 * b['median']:.1f} ms, "
            f"90 % cover {b['coverage_90']:.3f}; properties 68 % cover {p['coverage_68']:.3f}, "
            f"95 % {p['coverage_95']:.3f}",
            flush=True,
        )


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line of this experiment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", type=Path, nargs="?")
    parser.add_argument("--cases", type=int, default=48)
    parser.add_argument("--output", type=Path, default=RESULTS / "calibration.json")
    options = parser.parse_args(arguments)
    document: dict = {"seed": SEED, "systematic_table": SYSTEMATIC.model_dump()}
    if options.recordings is not None:
        every = [read_case(folder) for folder in list_cases(options.recordings)]
        document["recordings"] = calibrate([case for case in every if case.healthy])
        report("recordings", document["recordings"])
    document["bank"] = calibrate(simulated_cases(options.cases), singles=1)
    report("bank", document["bank"])
    deviating = simulated_cases(options.cases // 3, seed=SEED + 1000, systematic=SYSTEMATIC)
    document["systematic"] = calibrate(deviating, singles=1)
    report("systematic", document["systematic"])
    options.output.parent.mkdir(parents=True, exist_ok=True)
    save(options.output, document)


if __name__ == "__main__":
    main()
