"""What touches what along a recorded motion, in words."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from simgap.simulators.mjcf.engine import mujoco

# chosen: s: a contact that is there again sooner was never lost: sensors' noise breaks it
BROKEN = 0.04
FREE = "free"
GROUND = "ground"  # a geom of the world without a name

Pairs = frozenset[tuple[int, int]]


def contact_labels(model: Any, t: np.ndarray, touched: Sequence[Pairs]) -> list[str]:
    """At times t `free`, or which bodies touch, such as `cube on board`.

    A contact begins and ends between samples: those on either side count too.
    """
    sets = [frozenset(_pair(model, a, b) for a, b in pairs) for pairs in touched]
    none: frozenset[str] = frozenset()
    wide = [a | b | c for a, b, c in zip([none, *sets], sets, [*sets[1:], none], strict=False)]
    return [", ".join(sorted(s)) or FREE for s in closed(t, wide)]


def closed(t: np.ndarray, sets: Sequence[frozenset]) -> list[frozenset]:
    """What touches at times t, with gaps below BROKEN filled. A touch counts however brief it is, for an
    impact is brief."""
    out = [set(s) for s in sets]
    for pair in frozenset().union(*sets):
        rows = [i for i, s in enumerate(sets) if pair in s]
        for a, b in itertools.pairwise(rows):
            if t[b] - t[a] <= BROKEN:
                for i in range(a, b):
                    out[i].add(pair)
    return [frozenset(s) for s in out]


def _pair(model: Any, one: int, other: int) -> str:
    """What moves, on what it touches; geoms of the world go last."""
    return " on ".join(_name(model, g) for g in sorted((one, other), key=lambda g: _order(model, g)))


def _order(model: Any, geom: int) -> tuple[bool, str]:
    return int(model.geom_bodyid[geom]) == 0, _name(model, geom)


def _name(model: Any, geom: int) -> str:
    """The name of a geom's body; of the world's geoms, their own."""
    body = int(model.geom_bodyid[geom])
    kind, number = (mujoco.mjtObj.mjOBJ_BODY, body) if body else (mujoco.mjtObj.mjOBJ_GEOM, geom)
    return mujoco.mj_id2name(model, kind, number) or (f"body {body}" if body else GROUND)


def touching_pairs(
    model: Any, data: Any, poses: np.ndarray, at: Sequence[int]
) -> list[frozenset[tuple[int, int]]]:
    """Pairs of geoms that touch in each pose (n, k), whose coordinates are `at` these of the model's."""
    out, none = [], frozenset()
    for pose in poses:
        data.qpos[at] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        found = data.contact[: data.ncon] if data.ncon else ()
        out.append(frozenset((int(c.geom1), int(c.geom2)) for c in found) or none)
    return out
