"""What sensors' noise makes of fitted candidates: the same ones on recordings with a little more noise.

`simgap.attribution.noise_products` takes it off the products of their columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from simgap.gap.evaluation import evaluated
from simgap.gap.fit import Fitted
from simgap.gap.nuisances import with_nuisances
from simgap.gap.problem import Problem

Other = TypeVar("Other")

# numerics: signs of draws by places; products of what has different places cancel over the draws
SIGNS = np.array([[1, 1], [1, -1]], float)
SIZES = (1.0, -0.25)  # numerics: sds of noise of a draw; both tell whether it acts in proportion
ALIKE = 0.5  # numerics: by which share of the larger both may differ


def redrawn(given: Problem) -> tuple[Problem, ...]:
    """The problem with more noise on what was recorded: of every draw one of each of SIZES.

    Every number is off by its sensor's standard deviation, up or down. Signs of a sample and the next, and
    of a channel and the next, are orthogonal over the draws, so that squares of what combines these have
    their expectation without any scatter.
    """
    world, sensor = given.frame.world, given.frame.arrays.sensor
    place = (np.arange(world.t.shape[1])[:, None] + np.arange(4)) % len(SIGNS)
    rng = np.random.default_rng(0)
    noise = {
        name: sensor[..., [k]] * rng.choice((-1.0, 1.0), (*world.t.shape, 4))
        for k, name in enumerate(("joints", "rates", "force"))
    }
    out = []
    for signs in SIGNS.T:
        for size in SIZES:
            shaken = {n: getattr(world, n) + size * signs[place] * each for n, each in noise.items()}
            frame = replace(given.frame, world=world._replace(**shaken))
            out.append(with_nuisances(replace(given, frame=frame)))
    return tuple(out)


def carried(columns: np.ndarray, others: Sequence[Other], on: Callable[[Other], np.ndarray]) -> np.ndarray:
    """What noise makes of columns (n, M), (D, n, M) draws, from those `on` the redrawn recordings.

    Where it does not act in proportion, as beside a contact that it makes or breaks, nothing is said.
    """
    changes = [(on(other) - columns) / size for other, size in zip(others, SIZES * len(SIGNS.T), strict=True)]
    out = []
    for one, other in zip(changes[::2], changes[1::2], strict=True):
        alike = np.abs(one - other) <= ALIKE * np.maximum(np.abs(one), np.abs(other))
        out.append(np.where(alike, (one + other) / 2, 0.0).astype(np.float32))
    return np.stack(out)


def on_other(other: Problem, f: Fitted) -> Fitted:
    """A fit's residual and derivatives at the same coordinates on another recording."""
    now = evaluated(other, f.effects, f.u, f.columns, [])
    return replace(f, residual=now.residual, push=now.push)


def noise_gained(others: Sequence[Problem], healthy: Fitted, f: Fitted) -> float:
    """What a fit gains [nats] over the one without effects by leaving less of the sensors' noise."""
    columns = np.stack([healthy.residual, f.residual], 1)
    noise = carried(
        columns,
        others,
        lambda other: np.stack([on_other(other, healthy).residual, on_other(other, f).residual], 1),
    )
    without, left = np.square(noise.astype(float)).sum(1).mean(0)
    return 0.5 * float(without - left)
