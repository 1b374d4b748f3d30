"""What the sensors' noise adds to the products of a gap's columns, to be taken off again.

An effect takes a recording back, noise and all: softer pads bring more of the force's noise into a
distance, a force read between two samples has less of it. Its columns are noisy, then, and by noise alone a
set of effects may leave smaller squares than none (errors in variables). Each product of two columns is in
expectation that of their noiseless parts and that of their noises; the second is known and subtracted: the
moments' correction of Fuller (Measurement Error Models, 1987), a corrected score (Nakamura, Biometrika 77,
1990). It needs no residual to be free of other errors, as a likelihood of both variables does.
"""

from __future__ import annotations

import numpy as np

from simgap.attribution.problem import Gap, Spectrum, cosines


def products(columns: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Products (G, M, M) of columns (n, M) by group (n,)."""
    size = int(group.max()) + 1
    out = np.zeros((size, columns.shape[1], columns.shape[1]))
    order = np.argsort(group, kind="stable")
    ends = np.cumsum(np.bincount(group, minlength=size))[:-1]
    for g, mine in enumerate(np.split(order, ends)):
        out[g] = columns[mine].T @ columns[mine]
    return out


def of_noise(gap: Gap, s: Spectrum) -> np.ndarray:
    """The noise's part (G, M, M) of the products of a spectrum's columns, the residual's own square left out.

    Of second order in deviations from where effects were linearised it is left out, too: no curvature is
    taken off, so that every mode stays a maximum.
    """
    assert gap.carried is not None
    rows, columns = gap.rows, gap.carried
    out = np.zeros((int(s.group.max()) + 1, columns.shape[2], columns.shape[2]))
    noisy = np.flatnonzero((columns != 0).any((0, 1)))
    for draw in columns:
        white, _ = cosines(rows, draw[:, noisy].astype(float), rows.shape)
        out[:, noisy[:, None], noisy] += products(white, s.group) / len(columns)
    slopes = np.ones(columns.shape[2], bool)
    slopes[[0, *(mine[0] for mine in gap.own_columns)]] = False
    out[:, slopes[:, None] & slopes] = 0.0
    out[:, 0, 0] = 0.0
    turn = gap.to_constant
    return np.einsum("ia,gij,jb->gab", turn, out, turn, optimize=True)
