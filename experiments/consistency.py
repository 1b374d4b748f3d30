"""How far the scales of recordings in FOLDERs disagree: `python -m experiments.consistency FOLDER...`.

Of healthy hands these are what `estimation.consistency` takes for well made; its false alarms are counted.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from estimation.consistency import WELL_MADE, ties
from estimation.design import build
from estimation.observations import aligned_weights, with_slides
from estimation.sampler import CERTAIN
from hmmseg.api import align
from hmmseg.errors import InputError


def main(folders: list[str]) -> None:
    """Every tie of every case on a line, then the spread of each kind over all."""
    found, alarms, cases = defaultdict(list), 0, 0
    for folder in map(Path, folders):
        try:
            aligned = align(
                sorted(map(str, folder.glob("trial_*.csv"))), folder / "task.toml", folder / "rig.toml"
            )
        except InputError as error:
            print(f"{folder.name}: {error}", flush=True)
            continue
        weighed, noise = aligned_weights(aligned, np.random.default_rng(0))
        weighed = with_slides(weighed, noise, aligned.rig)
        every = list(ties(aligned, weighed, build(aligned, weighed, noise)))
        cases, alarms = cases + 1, alarms + any(tie.probability > CERTAIN for tie in every)
        for tie in every:
            found[tie.kind].append(tie.value / np.hypot(1.0, tie.error / WELL_MADE[tie.kind]))
        parts = (f"{t.kind} {t.value:+.4f}+-{t.error:.4f}{'!' * (t.probability > CERTAIN)}" for t in every)
        print(f"{folder.name}: {', '.join(parts)}", flush=True)
    for kind, values in found.items():
        print(f"{kind}: root mean square {np.sqrt(np.mean(np.square(values))):.4f} of {len(values)}")
    print(f"contradictions in {alarms} of {cases}")


if __name__ == "__main__":
    main(sys.argv[1:])
