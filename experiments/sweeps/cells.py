"""The cells of the sweeps: conditions under which trials are recorded, one or two at a time.

Every cell uses the same performances (trial number = seed), so that cells differ by their
condition alone; the sensor noise of a trial is the same draw at every level, scaled.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

CHUNK = 16  # trials a unit; they are simulated side by side
THRESHOLDS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)  # of the paper's 0.05 N and 0.05 m/s


@dataclass(frozen=True)
class Cell:
    """One condition.

    `noise` and `pace` (rate of work) in units of the usual ones; `rate` [Hz]; `vibration` [N], its
    amplitude at a contact change; `missing`, the share of the recording's values that are lost;
    `grasp` [m], height of the grip over the block's centre; `stated`: the rig states its noise.
    """

    noise: float = 1.0
    rate: float = 20.0
    pace: float = 1.0
    vibration: float = 0.0
    missing: float = 0.0
    grasp: float = 0.0
    stated: bool = True

    @property
    def key(self) -> str:
        """What differs from the usual, as `noise=4`; `nominal` where nothing does."""
        usual = Cell()
        changed = [(f.name, getattr(self, f.name)) for f in fields(self)
                   if getattr(self, f.name) != getattr(usual, f.name)]  # fmt: skip
        return "_".join(f"{name}={value:g}" for name, value in changed) or "nominal"


@dataclass(frozen=True)
class Unit:
    """Trials `first` to `first + CHUNK - 1` of a cell; the first `sampled` of them in full."""

    cell: Cell
    first: int

    @property
    def key(self) -> str:
        """Name of the unit, as `noise=4.0016`."""
        return f"{self.cell.key}.{self.first:04d}"

    @property
    def trials(self) -> range:
        """Trial numbers, which are the seeds of their performances."""
        return range(self.first, self.first + CHUNK)

    @property
    def sampled(self) -> int:
        """How many of the trials the sampler runs for: one of a unit, on side sweeps of every other."""
        return int(self.cell in PLANE or self.first // CHUNK % 2 == 0)


NOISE = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
SWEEPS: dict[str, dict[float, Cell]] = {
    "noise": {v: Cell(noise=v) for v in NOISE},
    "unstated": {v: Cell(noise=v, stated=False) for v in NOISE},
    "rate": {v: Cell(rate=v) for v in (10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)},
    "pace": {v: Cell(pace=v) for v in (0.5, 0.75, 1.0, 1.5, 2.0, 3.0)},
    "vibration": {v: Cell(vibration=v) for v in (0.0, 0.05, 0.1, 0.2, 0.5, 1.0)},
    "missing": {v: Cell(missing=v) for v in (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)},
    "grasp": {v: Cell(grasp=v) for v in (-0.004, -0.002, 0.0, 0.002, 0.004)},
}
PLANE = frozenset(SWEEPS["noise"].values())
PLANE_CHUNKS, LINE_CHUNKS = 13, 4  # 208 trials a cell of the main plane, 64 of the others
SMALL = {"noise": (0.25, 1.0, 4.0, 16.0), "rate": (10.0, 1000.0), "pace": (0.5, 3.0),
         "vibration": (0.2, 1.0), "missing": (0.1, 0.4), "grasp": (0.004,)}  # fmt: skip


def units(small: bool = False) -> list[Unit]:
    """All units of the sweeps, no cell twice. The small sweep's are the first of some full cells."""
    if small:
        cells = [SWEEPS[sweep][level] for sweep, levels in SMALL.items() for level in levels]
        return [Unit(cell, 0) for cell in cells]
    cells = list(dict.fromkeys(cell for sweep in SWEEPS.values() for cell in sweep.values()))
    counts = [PLANE_CHUNKS if cell in PLANE else LINE_CHUNKS for cell in cells]
    return [Unit(cell, k * CHUNK) for cell, n in zip(cells, counts, strict=True) for k in range(n)]
