"""The position-controlled hand performing a command: fingertips that feel what they touch.

Each fingertip is a mass drawn to the commanded motion by a spring and a damper (impedance
control: Hogan, J. Dyn. Sys. Meas. Control 107, 1985) and held back by the contact forces, so
that grip and pressing come from commanding positions beyond the contact.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from simgap.world.dynamics import Loads, Physics, Scalar, State, Tips, drift, interact, kick

Values = Any  # a jax Array in compiled code, a NumPy array after it
CONTROL_PERIOD = 1e-3  # numerics: s; commands and records are this far apart
BUCKET = 4000  # numerics: control periods; commands are padded to multiples, so that few programs are made


class Impedance(NamedTuple):
    """A fingertip of the controlled hand: `mass` [kg], `stiffness` [N/m], `damping` [N s/m]."""

    mass: Scalar
    stiffness: Scalar
    damping: Scalar


class Record(NamedTuple):
    """What happened, one row per control period; F fingers (2), B blocks.

    Tips: `position`, `velocity`, `force` (T, F, 2) [m, m/s, N] with x and y last. `blocks` and
    `block_velocity` (T, B, 2) [m, m/s]. `pads` (T, F, B): normal forces [N]. `support` (T, B):
    force from beneath [N].
    """

    position: Values
    velocity: Values
    force: Values
    blocks: Values
    block_velocity: Values
    pads: Values
    support: Values


@partial(jax.jit, static_argnames=("substeps",))
def perform(physics: Physics, hand: Impedance, command: Array, state: State, substeps: int) -> Record:
    """Record of a commanded motion: `command` (T, 4) is x1, y1, x2, y2 [m] per control period.

    Tips start at rest at the first command. Between commands the motion is linear.
    """
    h = CONTROL_PERIOD / substeps
    slope = jnp.diff(command, axis=0, append=command[-1:]) / CONTROL_PERIOD
    start = _tips(command[0], jnp.zeros(4))

    def period(carry: tuple[State, Tips], row: Array) -> tuple[tuple[State, Tips], Array]:
        state, tips = carry
        _, loads = interact(physics, state, tips)
        out = _row(state, tips, loads)

        def one(k: Array, carry: tuple[State, Tips]) -> tuple[State, Tips]:
            state, tips = carry
            target = _tips(row[:4] + row[4:] * ((k + 0.5) * h), row[4:])
            tips = _move(tips, h / 2)
            state, loads = interact(physics, drift(state, h / 2), tips)
            tips = _move(_pull(hand, tips, target, loads, h), h / 2)
            return drift(kick(physics, state, loads, h), h / 2), tips

        return jax.lax.fori_loop(0, substeps, one, carry), out

    _, rows = jax.lax.scan(period, (state, start), jnp.concatenate([command, slope], axis=1))
    return _record(rows, len(state.x))


def _tips(positions: Array, velocities: Array) -> Tips:
    x1, y1, x2, y2 = (positions[k] for k in range(4))
    vx1, vy1, vx2, vy2 = (velocities[k] for k in range(4))
    return Tips((x1, x2), (y1, y2), (vx1, vx2), (vy1, vy2))


def _move(tips: Tips, h: Scalar) -> Tips:
    return tips._replace(x=tuple(a + h * v for a, v in zip(tips.x, tips.vx, strict=True)),
                         y=tuple(a + h * v for a, v in zip(tips.y, tips.vy, strict=True)))  # fmt: skip


def _pull(hand: Impedance, tips: Tips, target: Tips, loads: Loads, h: Scalar) -> Tips:
    """Tip velocities after h [s] of the controller's pull and the reaction of what is touched."""

    def speed(position: Scalar, velocity: Scalar, aim: Scalar, rate: Scalar, load: Scalar) -> Scalar:
        pull = hand.stiffness * (aim - position) + hand.damping * (rate - velocity)
        return velocity + h / hand.mass * (pull - load)

    return tips._replace(vx=tuple(map(speed, tips.x, tips.vx, target.x, target.vx, loads.fx)),
                         vy=tuple(map(speed, tips.y, tips.vy, target.y, target.vy, loads.fy)))  # fmt: skip


def _row(state: State, tips: Tips, loads: Loads) -> Array:
    """Everything recorded, in the order `_record` takes it apart."""
    parts = [tips.x, tips.y, tips.vx, tips.vy, loads.fx, loads.fy, state.x, state.y, state.vx, state.vy,
             *loads.pads, loads.support]  # fmt: skip
    return jnp.stack([value for part in parts for value in part])


def _record(rows: Array, num_blocks: int) -> Record:
    """Rows of `_row` taken apart."""

    def pair(start: int, width: int) -> Array:
        return jnp.stack([rows[:, start : start + width], rows[:, start + width : start + 2 * width]], -1)

    n, b = num_blocks, 12
    return Record(pair(0, 2), pair(4, 2), pair(8, 2), pair(b, n), pair(b + 2 * n, n),
                  rows[:, b + 4 * n : b + 6 * n].reshape(-1, 2, n), rows[:, b + 6 * n :])  # fmt: skip
