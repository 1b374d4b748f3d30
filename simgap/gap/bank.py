"""The committed bank: noise model, detection thresholds and calibration learned on simulations."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

from simgap.gap.judge import Calibration
from simgap.gap.locate import Detection
from simgap.gap.noise import NoiseModel

FILE = Path(__file__).with_name("bank.json")


@dataclass(frozen=True)
class Bank:
    """What healthy recordings look like and how sure a verdict may be."""

    noise: NoiseModel
    detection: Detection
    calibration: Calibration

    def to_json(self) -> str:
        """Text of the committed file."""
        table = {
            "noise": self.noise.to_json(),
            "detection": asdict(self.detection),
            "calibration": asdict(self.calibration),
        }
        return json.dumps(table, indent=1) + "\n"


def parse_bank(text: str) -> Bank:
    """Bank from `Bank.to_json`."""
    table = json.loads(text)
    d = table["detection"]
    detection = Detection(tuple(d["cell"]), tuple(d["pooled"]), tuple(d["gain"]), float(d["margin"]))
    return Bank(NoiseModel.from_json(table["noise"]), detection, Calibration(**table["calibration"]))


@cache
def load_bank() -> Bank:
    """The bank that comes with the package (written by experiments/gap_bank.py)."""
    return parse_bank(FILE.read_text(encoding="utf-8"))
