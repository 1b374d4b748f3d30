"""Hidden Markov models whose states come in a known order: a small library that needs no blocks.

    import hmmseg.hmm as hmm

    chain = hmm.left_to_right(mean_samples=[200, 50, 300])
    best = hmm.viterbi(log_likelihoods, chain)      # best.starts: where each state begins
    posterior = hmm.smooth(log_likelihoods, chain)  # posterior.boundary, posterior.start_intervals()

docs/hmm.md shows all of it. Nothing heavy is imported before it is used.
"""

from __future__ import annotations

from importlib import import_module

_HOMES = {
    "Alignment": "results",
    "Alignments": "results",
    "Chain": "chain",
    "Filtered": "results",
    "InfeasibleAlignment": "chain",
    "Posterior": "results",
    "forward": "inference",
    "k_best": "inference",
    "left_to_right": "chain",
    "log_evidence": "inference",
    "sample": "inference",
    "smooth": "inference",
    "viterbi": "inference",
}

__all__ = [  # noqa: F822
    "Alignment",
    "Alignments",
    "Chain",
    "Filtered",
    "InfeasibleAlignment",
    "Posterior",
    "forward",
    "k_best",
    "left_to_right",
    "log_evidence",
    "sample",
    "smooth",
    "viterbi",
]


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
