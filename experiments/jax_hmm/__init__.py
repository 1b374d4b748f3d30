"""The recursions of hmmseg.hmm in JAX, by themselves: what its kernels are compared with."""
