"""Weights, widths and heights so far, with what the rig says of errors that all rows share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmmseg.contact.decompose import height_equations
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask
from hmmseg.segmentation.rounds import one_round


class Properties:
    """What the means of weights, widths and rises say of every block.

    `steady` (num_moves,): whether a move rises by the same heights in every round; `signs` (num_moves,):
    which way it goes where that is known, 0 elsewhere.
    """

    def __init__(self, task: BlockTask, rounds: Sequence[BlockTask], rig: Rig) -> None:
        self.objects = task.objects
        each = [height_equations(one_round(one)) for one in rounds]
        self.steady = [len({str(sorted(e[m][1].items())) for e in each}) == 1 for m in range(len(task.moves))]
        self.equations = np.zeros((len(task.moves), len(task.objects)))
        self.signs = np.zeros(len(task.moves))
        for move, rise in each[0]:
            if self.steady[move] and rise and not task.moves[move].slide:
                for name, coefficient in rise.items():
                    self.equations[move, task.objects.index(name)] = coefficient
                if len({np.sign(v) for v in rise.values()}) == 1:
                    self.signs[move] = np.sign(next(iter(rise.values())))
        gain = np.array(rig.systematic.force_gain)
        self.weight_gain = float(np.hypot(gain[1], gain[3]) / 2)  # half of it on each finger
        self.touch_sd = 0.0  # how well the distance at which fingers touch is known, in all grips alike [m]
        self.force_sd = 0.0  # how well the zero of the net force is known, in all grips alike [N]
        self._seen: bytes = b""
        self._heights: tuple[np.ndarray, np.ndarray] = (np.zeros(0), np.zeros(0))

    def table(self, means: np.ndarray) -> list[tuple[str, str, float, float]]:
        """(object, property, mean, sd) of what is known more likely than not."""
        out = []
        for o, name in enumerate(self.objects):
            for q, prop in ((2 * o, "weight"), (2 * o + 1, "width")):
                if means[q, 2] > 0.5:
                    variance = means[q, 1]
                    if prop == "weight":
                        variance = variance + (self.weight_gain * means[q, 0]) ** 2 + self.force_sd**2
                    else:
                        variance = variance + self.touch_sd**2
                    out.append((name, prop, float(means[q, 0]), float(np.sqrt(variance))))
        rises = means[2 * len(self.objects) :]
        if rises.size and (rises[:, 2] > 0.5).any():
            key = rises.tobytes()
            if key != self._seen:
                self._seen, self._heights = key, self._solve(rises)
            mean, sd = self._heights
            out += [(name, "height", float(m), float(s))
                    for name, m, s in zip(self.objects, mean, sd, strict=True) if np.isfinite(s)]  # fmt: skip
        return out

    def _solve(self, rises: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Heights (num_objects,) that the rises determine, and their sds (inf where they do not)."""
        used = (rises[:, 2] > 0.5) & (self.equations != 0).any(axis=1)
        n = len(self.objects)
        mean, sd = np.zeros(n), np.full(n, np.inf)
        if not used.any():
            return mean, sd
        a = self.equations[used] / np.sqrt(rises[used, 1])[:, None]
        b = rises[used, 0] / np.sqrt(rises[used, 1])
        inverse = np.linalg.pinv(a.T @ a)
        determined = np.abs(np.linalg.pinv(a) @ a - np.eye(n)).max(axis=1) < 1e-9
        mean[determined] = (inverse @ a.T @ b)[determined]
        sd[determined] = np.sqrt(np.diag(inverse))[determined]
        return mean, sd
