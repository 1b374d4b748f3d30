"""Hidden Markov models whose states come in a known order: a small library that needs no blocks.

    import hmmseg.hmm as hmm

    chain = hmm.left_to_right(mean_samples=[200, 50, 300])
    best = hmm.viterbi(log_likelihoods, chain)      # best.starts: where each state begins
    posterior = hmm.smooth(log_likelihoods, chain)  # posterior.boundary, posterior.start_intervals()

docs/hmm.md shows all of it. Nothing heavy is imported before it is used.
"""

from hmmseg._lazy import lazily

__getattr__, __dir__, __all__ = lazily(__name__, __file__)
