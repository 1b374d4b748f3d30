"""Draws where it is open whether the rig's pads are as it says: from both possibilities, by their odds.

Slopes within a grip may contradict `[fingertip]` without proving it wrong (`compliance.misstated`). One
design then believes the rig, another doubts it by as much as the slopes say; widths are drawn from the
latter with the probability that the pads' give along the grip is wrong, heights with that of their shear.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from estimation import priors
from estimation.channel_noise import Noise
from estimation.design import Design, build
from estimation.nuisance import PadDoubt
from estimation.observations import WeighedTrial
from estimation.posterior import Posterior, posterior
from estimation.sampler import Draws, sample
from estimation.unknowns import DISTANCE, RISE
from hmmseg.segmentation.align import AlignedTrials

CERTAIN = 0.99  # chosen: probability from which it is said, and taken for true, that the rig's pads are wrong


def designs(
    aligned: AlignedTrials, weighed: Sequence[WeighedTrial], noise: Noise
) -> tuple[Design, Design | None]:
    """The likelier design, and the other one where it is open whether the rig's pads are right."""
    found = build(aligned, weighed, noise)
    if not found.unknowns or not any(0 < odds < CERTAIN for odds in found.doubt.odds):
        return found, None
    return found, build(aligned, weighed, noise, not found.doubt.doubted)


def sample_either(
    likelier: Design, other: Design | None, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> tuple[Posterior, Draws]:
    """The likelier design's posterior and draws of its unknowns, mixed with the other's by their odds.

    Scales, shares and deviations stay those of the likelier; the other is left out if it does not converge.
    """
    first = posterior(likelier)
    found = sample(first, seed, progress)
    if other is None or not found.converged:
        return first, found
    second = sample(posterior(other), seed)
    return first, found if not second.converged else mixed(
        found, second, [u.prop for u in likelier.unknowns], likelier.doubt, seed
    )


def mixed(likelier: Draws, other: Draws, props: Sequence[str], doubt: PadDoubt, seed: int) -> Draws:
    """Draws of the likelier, those of each channel replaced by the other's with its probability.

    `props`: of the unknowns; `doubt`: the likelier's.
    """
    rng, chain = np.random.default_rng([seed, 17]), likelier.chain.copy()
    flat = chain.reshape(-1, chain.shape[-1])
    instead = other.flat[rng.integers(len(other.flat), size=len(flat))]
    for channel, odds in zip((DISTANCE, RISE), doubt.odds, strict=True):
        wrong = 1.0 if odds >= CERTAIN else odds
        swapped = rng.uniform(size=len(flat)) < (1 - wrong if doubt.doubted else wrong)
        mine = np.array([priors.CHANNEL[prop] == channel for prop in props])
        taken = swapped[:, None] & mine
        flat[taken] = instead[taken]
    return replace(likelier, chain=flat.reshape(chain.shape))
