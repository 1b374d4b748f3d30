"""Hidden Markov models over plain log-likelihoods; usable without blocks."""
