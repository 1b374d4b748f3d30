"""The same alignment by every library at hand, as functions of nothing; what is not installed is left out.

General libraries take a matrix of transitions and have no end-state constraint: the last row of what they are
given forbids all states but the last.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable

import numpy as np

import hmmseg.hmm as hmm

Functions = dict[str, Callable[[], np.ndarray]]
DOUBLE, SINGLE = "hmmseg, float64, as called", "hmmseg, float32, as called"
JAX_DOUBLE, JAX_SINGLE = "hmmseg, JAX inside jit, float64", "hmmseg, JAX inside jit, float32"
HMMLEARN, DYNAMAX, RUPTURES = "hmmlearn's kernel", "dynamax", "ruptures"
LIBRARIES = ("hmmlearn", "dynamax", "ruptures", "pomegranate", "jax", "numba", "numpy", "hmmseg")


def versions() -> dict[str, str | None]:
    """Version of every library, None where it is not installed."""
    found: dict[str, str | None] = {}
    for name in LIBRARIES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def matrix(chain: hmm.Chain) -> np.ndarray:
    """Transition probabilities (num_states, num_states), which libraries of general models take."""
    return np.diag(np.exp(chain.bands[0])) + np.diag(np.exp(chain.bands[1]), 1)


def ended(x: np.ndarray) -> np.ndarray:
    """Log-likelihoods that force the last state at the end."""
    out = np.array(x)
    out[-1, :-1] = -np.inf
    return out


def paths(x: np.ndarray, chain: hmm.Chain, jax_too: bool = True) -> Functions:
    """Viterbi paths, as states of all samples or as the first samples of all states."""
    found: Functions = {DOUBLE: lambda: _starts(hmm.viterbi(x, chain))}
    single = x.astype(np.float32)
    found[SINGLE] = lambda: _starts(hmm.viterbi(single, chain))
    dense, start = matrix(chain), np.eye(x.shape[1])[0]
    forced = ended(x)
    try:
        from hmmlearn import _hmmc

        found[HMMLEARN] = lambda: np.asarray(_hmmc.viterbi(start, dense, forced)[1])
    except ImportError:
        pass
    if not jax_too:
        return found
    import jax
    import jax.numpy as jnp

    from experiments import jax_viterbi

    jitted = jax.jit(lambda ll, stay, advance: jax_viterbi.viterbi(ll, stay, advance).path)
    for name, dtype in ((JAX_DOUBLE, jnp.float64), (JAX_SINGLE, jnp.float32)):
        inside = [jnp.asarray(a, dtype) for a in (x, *chain.bands)]
        found[name] = lambda inside=inside: np.asarray(jitted(*inside))
    try:
        from dynamax.hidden_markov_model.inference import hmm_posterior_mode

        mode = jax.jit(hmm_posterior_mode)
        arguments = [jnp.asarray(a) for a in (start, dense, forced)]
        found[DYNAMAX] = lambda: np.asarray(mode(*arguments))
    except ImportError:
        pass
    return found


def _starts(found: hmm.Alignment | hmm.Alignments) -> np.ndarray:
    return found.starts


def smoothers(x: np.ndarray, chain: hmm.Chain) -> dict[str, Callable[[], object]]:
    """Forward and backward passes; only ours says how probable every boundary is at every sample."""
    found: dict[str, Callable[[], object]] = {"hmmseg": lambda: hmm.smooth(x, chain)}
    dense, start = matrix(chain), np.eye(x.shape[1])[0]
    forced = ended(x)
    try:
        from hmmlearn import _hmmc

        found[HMMLEARN] = lambda: (
            _hmmc.forward_log(start, dense, forced),
            _hmmc.backward_log(start, dense, forced),
        )
    except ImportError:
        pass
    try:
        import jax
        import jax.numpy as jnp
        from dynamax.hidden_markov_model.inference import hmm_smoother

        jitted = jax.jit(lambda *a: hmm_smoother(*a).smoothed_probs)
        arguments = [jnp.asarray(a) for a in (start, dense, forced)]
        found[DYNAMAX] = lambda: jitted(*arguments).block_until_ready()
    except ImportError:
        pass
    return found


def change_points(signal: np.ndarray, num_states: int) -> Functions:
    """Starts of segments by ruptures, which looks for so many changes of the mean and knows no states."""
    try:
        import ruptures
    except ImportError:
        return {}

    def find() -> np.ndarray:
        search = ruptures.KernelCPD(kernel="linear", min_size=1).fit(signal[:, None])
        return np.array([0, *search.predict(n_bkps=num_states - 1)[:-1]])

    return {RUPTURES: find}
