"""The committed bank: noise model, detection thresholds and calibration learned on simulations."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from simgap.gap.judge import Calibration
from simgap.gap.locate import STATISTICS, Detection
from simgap.gap.noise import NoiseModel

FILE = Path(__file__).with_name("bank.json")
NOMINAL, BOOTSTRAP, CALIBRATED = "nominal", "bootstrap", "calibrated"


@dataclass(frozen=True)
class Reference:
    """What a bank was learned on: `simgap.gap.adapt.fingerprint` of its recordings, their length padded
    to `samples`, and what the linearised bootstrap (`simgap.gap.bootstrap`) gives of its `detection`.
    """

    fingerprint: str
    samples: int
    bootstrap: Detection


@dataclass(frozen=True)
class Bank:
    """What healthy recordings look like and how sure a verdict may be.

    `source` says whose recordings `detection` is of: NOMINAL, BOOTSTRAP or CALIBRATED. Without a
    `reference` it serves as it is.
    """

    noise: NoiseModel
    detection: Detection
    calibration: Calibration
    reference: Reference | None = None
    source: str = NOMINAL

    def to_json(self) -> str:
        """Text of the committed file; `source` is no part of it."""
        table = {
            "noise": self.noise.to_json(),
            "detection": asdict(self.detection),
            "calibration": asdict(self.calibration),
        }
        if self.reference is not None:
            table["reference"] = asdict(self.reference)
        return json.dumps(table, indent=1) + "\n"


def parse_bank(text: str) -> Bank:
    """Bank from `Bank.to_json`."""
    table = json.loads(text)
    reference = table.get("reference")
    if reference is not None:
        reference = Reference(**reference | {"bootstrap": _detection(reference["bootstrap"])})
    calibration = Calibration(**table["calibration"])
    return Bank(NoiseModel.from_json(table["noise"]), _detection(table["detection"]), calibration, reference)


def _detection(table: dict[str, Any]) -> Detection:
    return Detection(**{name: tuple(table[name]) for name in STATISTICS}, margin=float(table["margin"]))


@cache
def load_bank() -> Bank:
    """The bank that comes with the package (written by experiments/gap_bank.py)."""
    return parse_bank(FILE.read_text(encoding="utf-8"))
