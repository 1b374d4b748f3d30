"""Recursions over samples, compiled; to be imported late, as numba takes half a second."""

from __future__ import annotations

import numpy as np

from hmmseg.online.compiled import compiled


@compiled
def smoothed(t: np.ndarray, values: np.ndarray, tau: float, start: float) -> np.ndarray:
    """tau y' + y = u (num_timesteps,), linear between the times `t` of its samples, from a `start` on."""
    out = np.empty_like(values)
    out[0] = start
    for i in range(values.size - 1):
        step = t[i + 1] - t[i]
        late = tau * (values[i + 1] - values[i]) / step
        # On each piece y = u - tau slope + decaying rest.
        out[i + 1] = values[i + 1] - late + np.exp(-step / tau) * (out[i] - values[i] + late)
    return out


@compiled
def play(values: np.ndarray, width: float) -> np.ndarray:
    """The play operator: the output (n,) follows the input only where that pushes a side of the gap."""
    out = np.empty_like(values)
    at = values[0]
    for i in range(values.size):
        if np.isfinite(values[i]):
            at = min(max(at, values[i] - width / 2), values[i] + width / 2)
        out[i] = at
    return out


@compiled
def recursion(keep: np.ndarray, drive: np.ndarray, start: np.ndarray) -> np.ndarray:
    """y[k] = keep[k] y[k-1] + drive[k] along the samples of T trials (T, N), from a `start` (T,) on."""
    out = np.empty_like(drive)
    for t in range(drive.shape[0]):
        y = start[t]
        for k in range(drive.shape[1]):
            y = keep[t, k] * y + drive[t, k]
            out[t, k] = y
    return out


@compiled
def _update(
    mean: np.ndarray, cov: np.ndarray, lever: np.ndarray, value: float, weight: float, noise: float
) -> tuple[float, float]:
    """Take one value, lever' state and noise of variance `noise` over `weight`, into `mean` (S,) and `cov`
    (S, S) in place; the innovation, and its variance over the noise's, weighted."""
    size = mean.size
    spread, inside, miss = np.zeros(size), 0.0, value
    for i in range(size):
        for j in range(size):
            spread[i] += cov[i, j] * lever[j]
        inside += lever[i] * spread[i]
        miss -= lever[i] * mean[i]
    larger = 1 + weight * inside / noise
    for i in range(size):
        gain = weight / (noise * larger) * spread[i]
        mean[i] += gain * miss
        for j in range(size):
            cov[i, j] -= gain * spread[j]
    return miss, larger


@compiled
def tracked(
    values: np.ndarray, weight: np.ndarray, sd: np.ndarray, levers: np.ndarray, walk: np.ndarray,
    new: np.ndarray, anywhere: float, pinned: np.ndarray, place: np.ndarray, drift: np.ndarray,
    wander: np.ndarray, jump: np.ndarray, shares: np.ndarray, chance: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """What a Kalman filter did not expect of four values (T, N, 4), where joints move unseen.

    Values are `levers` (T, N, 4, J) times where the J joints are in their dead bands, and noise `sd`; values
    of less `weight` (0 to 1) tell less. The first, second and last also have a constant each, which walks
    with variances `walk` (T, N, 3) and is another one, with variance `anywhere`, where it is `new` (T, N,
    3): the first value of weight sets it and tells nothing. A joint is at its `place` (T, N, J) where it is
    `pinned`; elsewhere it goes on by `drift`, with variance `wander`, and by one of `shares` (R,) of the
    variance `jump` (T, J), of which `chance` (R,) are the prior probabilities. Of these the likeliest is
    taken, sample by sample (a multiprocess model, class II: Harrison & Stevens, JRSS B 38, 1976).

    Returns:
        innovations (T, N, 4), their variances over the noise's, and what the choices cost [nats].
    """
    joints, size = pinned.shape[2], pinned.shape[2] + 3
    out, factor, cost = np.zeros_like(values), np.ones_like(values), 0.0
    constant = np.array([joints, joints + 1, -1, joints + 2])
    lever = np.zeros(size)
    for t in range(values.shape[0]):
        mean, cov, fresh = np.zeros(size), np.zeros((size, size)), np.ones(size)
        for k in range(values.shape[1]):
            for c in range(3):
                i = joints + c
                cov[i, i] += walk[t, k, c]
                if k == 0 or new[t, k, c]:
                    cov[i, :] = 0.0
                    cov[:, i] = 0.0
                    cov[i, i], fresh[i] = anywhere, 1.0
            loose = False
            for j in range(joints):
                if k == 0 or pinned[t, k, j]:
                    cov[j, :] = 0.0
                    cov[:, j] = 0.0
                    mean[j] = place[t, k, j]
                    cov[j, j] = 0.0 if pinned[t, k, j] else jump[t, j]
                else:
                    mean[j] += drift[t, k, j]
                    cov[j, j] += wander[t, k, j]
                loose = loose or not pinned[t, k, j]
            choices = chance.size if loose and weight[t, k].sum() > 0 else 1
            best, chosen_mean, chosen_cov, paid = -np.inf, mean, cov, 0.0
            for r in range(choices):
                m, p = (mean.copy(), cov.copy()) if choices > 1 else (mean, cov)
                for j in range(joints):
                    if not pinned[t, k, j]:
                        p[j, j] += shares[r] * jump[t, j]
                score = np.log(chance[r]) if choices > 1 else 0.0
                prior = score
                misses, factors = np.zeros(4), np.ones(4)
                for c in range(4):
                    w, noise = weight[t, k, c], sd[t, k, c] ** 2
                    if w <= 0:
                        continue
                    lever[:] = 0.0
                    lever[:joints] = levers[t, k, c]
                    known = 1.0
                    if constant[c] >= 0:
                        lever[constant[c]] = 1.0
                        known = 1 - fresh[constant[c]]
                    miss, larger = _update(m, p, lever, values[t, k, c], w, noise)
                    factors[c] = larger**known
                    misses[c] = np.sqrt(known * factors[c] / larger) * w * miss
                    score -= 0.5 * (np.log(factors[c]) + misses[c] ** 2 / (noise * factors[c]))
                if score > best:
                    best, chosen_mean, chosen_cov, paid = score, m, p, -prior
                    out[t, k], factor[t, k] = misses, factors
            cost += paid
            mean, cov = chosen_mean, chosen_cov
            for c in range(4):
                if constant[c] >= 0:
                    fresh[constant[c]] *= 1 - weight[t, k, c]
    return out, factor, cost
