"""Hidden Markov models whose states come in a known order: a small library that needs no blocks.

    import hmmseg.hmm as hmm

    chain = hmm.left_to_right(mean_samples=[200, 50, 300])
    best = hmm.viterbi(log_likelihoods, chain)      # best.starts: where each state begins
    posterior = hmm.smooth(log_likelihoods, chain)  # posterior.boundary, posterior.start_intervals()

docs/hmm.md shows all of it. Nothing heavy is imported before it is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hmmseg._lazy import lazily

if TYPE_CHECKING:
    from hmmseg.hmm.chain import Chain, InfeasibleAlignment, left_to_right
    from hmmseg.hmm.durations import DurationChain, lasting
    from hmmseg.hmm.inference import filter, k_best, log_evidence, sample, smooth, viterbi
    from hmmseg.hmm.learn import Durations, Emission, em
    from hmmseg.hmm.results import Alignment, Alignments, Filtered, Posterior
    from hmmseg.hmm.streaming import Step, StreamingFilter, Window

_MODULES = {
    "chain": ("Chain", "InfeasibleAlignment", "left_to_right"),
    "durations": ("DurationChain", "lasting"),
    "inference": ("filter", "k_best", "log_evidence", "sample", "smooth", "viterbi"),
    "learn": ("Durations", "Emission", "em"),
    "results": ("Alignment", "Alignments", "Filtered", "Posterior"),
    "streaming": ("Step", "StreamingFilter", "Window"),
}
_HOMES = {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names}

__all__ = [
    "Alignment",
    "Alignments",
    "Chain",
    "DurationChain",
    "Durations",
    "Emission",
    "Filtered",
    "InfeasibleAlignment",
    "Posterior",
    "Step",
    "StreamingFilter",
    "Window",
    "em",
    "filter",
    "k_best",
    "lasting",
    "left_to_right",
    "log_evidence",
    "sample",
    "smooth",
    "viterbi",
]

__getattr__, __dir__ = lazily(__name__, _HOMES)
