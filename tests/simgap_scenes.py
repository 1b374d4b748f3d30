"""Scenes shared by the tests of the virtual model: constants, blocks at rest, fixed tips."""

import jax
import jax.numpy as jnp

from hmmseg.io.rig import Finger, Fingertip, Noise, Rig
from hmmseg.io.task import GROUND, BlockTask, Move
from simgap.world.dynamics import Physics, State, Tips, resting_state, substep
from simgap.world.properties import Block
from simgap.world.virtual_model import Surroundings, physics

RIG = Rig(fingertip=Fingertip(normal_stiffness=4000.0, shear_stiffness=2500.0))
HAND = Rig(rate=20.0, fingers={"1": Finger(base=(0.05, 0.17), links=(0.12, 0.12)),
                               "2": Finger(base=(0.21, 0.17), links=(0.12, 0.12))},
           fingertip=Fingertip(normal_stiffness=4000.0, shear_stiffness=2500.0),
           noise=Noise(angle=2e-4, velocity=0.03, force=0.012))  # fmt: skip
STACK = BlockTask({"block1": "block2", "block2": GROUND}, (Move("block1", GROUND), Move("block2", "block1")))


def scene(blocks: list[Block] | None = None, **around: float) -> Physics:
    return physics(RIG, blocks or [Block(0.4, 0.02, 0.016)],
                   Surroundings(**({"support_stiffness": 1e5} | around)))  # fmt: skip


def at(constants: Physics, *centres: tuple[float, float]) -> State:
    return resting_state(constants, [jnp.asarray(x) for x, _ in centres],
                         [jnp.asarray(y) for _, y in centres])  # fmt: skip


def tips(x1: float, y1: float, x2: float, y2: float) -> Tips:
    zero = jnp.asarray(0.0)
    return Tips((jnp.asarray(x1), jnp.asarray(x2)), (jnp.asarray(y1), jnp.asarray(y2)), (zero, zero),
                (zero, zero))  # fmt: skip


FAR = tips(-1.0, 1.0, 1.0, 1.0)


def evolve(constants: Physics, state: State, fingers: Tips, h: float, steps: int) -> State:
    def one(s: State, _: None) -> tuple[State, State]:
        s = substep(constants, s, fingers, h)
        return s, s

    return jax.jit(lambda s: jax.lax.scan(one, s, None, length=steps)[1])(state)
