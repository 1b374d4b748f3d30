"""Compiled host kernels (numba): everything of hmmseg.hmm that runs outside of JAX.

Weights are kept as mantissa and exponent, m 2^e with an integer e of its own for each state, so
that nothing underflows however far a state falls behind: sums cost a multiplication and a shift
where logarithms would cost an exponential and a logarithm. Accumulation is in double precision
whatever the input's.

Nothing here is imported before a kernel is first needed.
"""
