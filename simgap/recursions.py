"""Compiled recursions over samples; import late, as numba takes half a second to load."""

from __future__ import annotations

import numpy as np

from hmmseg.online.compiled import compiled


@compiled
def smoothed(t: np.ndarray, values: np.ndarray, tau: float, start: float) -> np.ndarray:
    """Solution y of tau y' + y = u from y(t[0]) = `start`, for u (num_timesteps,) linear between times
    `t`."""
    out = np.empty_like(values)
    out[0] = start
    for i in range(values.size - 1):
        step = t[i + 1] - t[i]
        late = tau * (values[i + 1] - values[i]) / step
        # On each piece y = u - tau slope + a decaying rest.
        out[i + 1] = values[i + 1] - late + np.exp(-step / tau) * (out[i] - values[i] + late)
    return out


@compiled
def play(values: np.ndarray, width: float) -> np.ndarray:
    """The play operator: the output (n,) follows the input only while it pushes a side of the gap."""
    out = np.empty_like(values)
    at = values[0]
    for i in range(values.size):
        if np.isfinite(values[i]):
            at = min(max(at, values[i] - width / 2), values[i] + width / 2)
        out[i] = at
    return out


@compiled
def recursion(keep: np.ndarray, drive: np.ndarray, start: np.ndarray) -> np.ndarray:
    """y[k] = keep[k] y[k-1] + drive[k] along the samples of T trials (T, N), from y[-1] = `start` (T,)."""
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
    """Kalman update of `mean` (S,) and `cov` (S, S), in place, with one value: lever' state plus noise of
    variance `noise` / `weight`. Returns the innovation and its variance over the noise's, weighted."""
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
    wander: np.ndarray, jump: np.ndarray, shares: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """Innovations of a Kalman filter on four values (T, N, 4) while joints move unseen in their dead bands.

    Values are `levers` (T, N, 4, J) times the positions of the J joints in their bands, plus noise of
    standard deviation `sd`; each has a `weight` from 0 to 1. The first, second and last value also have a
    constant each, a random walk of variances `walk` (T, N, 3) that is replaced by a new one of variance
    `anywhere` where `new` (T, N, 3): the first weighted value determines it and gives no innovation. A joint
    is at its `place` (T, N, J) where `pinned`; elsewhere all rest, at a share 0, or move by `drift` with
    variance `wander` plus one of `shares` (R,) of the variance `jump` (T, J), each share as often after the
    last one as in the trial so far (once beforehand): noise of speeds is no motion of a hand at rest. The
    density of a sample is the mean over shares; the likeliest one is kept (a multiprocess model, class II:
    Harrison & Stevens, JRSS B 38, 1976).

    Returns:
        Innovations (T, N, 4), their variances over the noise's, and what the mean lacks of the density of the
        share kept [nats].
    """
    joints, size = pinned.shape[2], pinned.shape[2] + 3
    out, factor, cost = np.zeros_like(values), np.ones_like(values), 0.0
    constant = np.array([joints, joints + 1, -1, joints + 2])
    lever = np.zeros(size)
    for t in range(values.shape[0]):
        mean, cov, fresh = np.zeros(size), np.zeros((size, size)), np.ones(size)
        followed, last = np.ones((shares.size, shares.size)), 0
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
                loose = loose or not pinned[t, k, j]
            choices = shares.size if loose and weight[t, k].sum() > 0 else 1
            chance, kept = followed[last] / followed[last].sum(), 0
            best, chosen_mean, chosen_cov, seen, every = -np.inf, mean, cov, 0.0, -np.inf
            for r in range(choices):
                m, p = (mean.copy(), cov.copy()) if choices > 1 else (mean, cov)
                for j in range(joints):
                    if pinned[t, k, j]:
                        continue
                    if k > 0 and (choices == 1 or shares[r] > 0):
                        m[j] += drift[t, k, j]
                        p[j, j] += wander[t, k, j]
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
                every = np.logaddexp(every, score)
                if score > best:
                    best, chosen_mean, chosen_cov, seen, kept = score, m, p, score - prior, r
                    out[t, k], factor[t, k] = misses, factors
            cost += seen - every
            if choices > 1:
                followed[last, kept] += 1
                last = kept
            mean, cov = chosen_mean, chosen_cov
            for c in range(4):
                if constant[c] >= 0:
                    fresh[constant[c]] *= 1 - weight[t, k, c]
    return out, factor, cost
