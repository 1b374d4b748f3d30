"""Helper of effects that act on joint angles: from true tips to what the nominal hand would read."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from hmmseg.hand.kinematics import forward, inverse, joint_velocity, tip_velocity
from simgap.effects.base import Performance

Change = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def moved_joints(
    performance: Performance,
    change: Change,
    scale: float | Sequence[float] = 0.0,
    base: Sequence[float] = (0.0, 0.0),
) -> Performance:
    """Tips as read by a nominal hand whose angles and rates (n, 4) pass through `change`.

    The true links are longer than nominal by `scale`, all or each (4,), the second finger stands beside its
    place by `base` (2,) [m].
    """
    rig = performance.rig
    if not rig.jointed:
        raise ValueError("a Cartesian hand has no joints")
    q, dq = [], []
    longer, shift = np.broadcast_to(np.asarray(scale, float), 4).reshape(2, 2), np.array([[0.0, 0.0], base])
    for i in (1, 2):
        nominal = rig.finger(i)
        true = nominal.model_copy(update={"links": tuple(nominal.links * (1 + longer[i - 1]))})
        angles = inverse(true, i, performance.position[:, i - 1] - shift[i - 1])
        q.append(angles)
        dq.append(joint_velocity(true, angles, performance.velocity[:, i - 1]))
    q, dq = change(np.concatenate(q, 1), np.concatenate(dq, 1))
    position = np.stack([forward(rig.finger(i + 1), q[:, 2 * i : 2 * i + 2]) for i in (0, 1)], 1)
    velocity = np.stack(
        [tip_velocity(rig.finger(i + 1), q[:, 2 * i : 2 * i + 2], dq[:, 2 * i : 2 * i + 2]) for i in (0, 1)],
        1,
    )
    return performance._replace(position=position, velocity=velocity)
