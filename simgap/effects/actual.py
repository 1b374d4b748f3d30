"""A property that was measured apart from the trials, and is wrong."""

from __future__ import annotations

import numpy as np

from simgap.effects.base import HAND, Effect, Parameter

WRONG = 0.05  # prior: share by which a measured property may be off


def _wrong(given, push: np.ndarray) -> list:
    """A candidate for each property that was measured apart."""
    from simgap.attribution.problem import Candidate
    from simgap.gap.tolerance import properties_tolerated

    out, nothing, least = [], np.zeros(1), properties_tolerated(given)
    for o, name in enumerate(given.frame.task.objects):
        for k, kind in enumerate(("weight", "width", "height")):
            column = push[:, 3 * o + k]
            if given.measured[o, k]:
                usual = np.full(1, WRONG * abs(given.centre[o, k]) / given.sd[o, k])
                out.append(Candidate(EFFECT.name, (f"{name}.{kind}",), nothing, nothing, usual,
                                     np.zeros(len(push)), -column[:, None], np.full(1, -np.inf),
                                     np.full(1, np.inf), least=least[[3 * o + k]]))  # fmt: skip
    return out


EFFECT = Effect(
    name="actual",
    acts_on="measurement",
    says="a value of actual.toml is off by a share of itself: its name is the parameter's",
    shows="what depends on that property alone",
    mistaken_for=("force_gain", "fingertip_compliance"),
    called="a measured block property that the recordings contradict",
    check="Weigh and measure the block again, and check the unit in actual.toml.",
    parameters=(Parameter("property", "1", WRONG),),
    stage=HAND,
    wrong=_wrong,
    wrist=True,
)
