"""Laws of one contact: a unilateral Kelvin-Voigt spring and Coulomb friction with an anchor.

Both laws are elementwise, continuous in all arguments and differentiable except at the edges of
contact and of the friction cone, where the derivative is one-sided and finite.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

FADE = 2e-5  # numerics: m; depth over which damping fades in, so that an impact starts without a jump


def normal_force(stiffness: Array, damping: Array, depth: Array, rate: Array) -> Array:
    """Normal force [N] of a spring that only pushes, 0 out of contact.

    `depth` [m] is positive inside, `rate` [m/s] its time derivative. A Kelvin-Voigt element
    whose damping [N s/m] fades in with depth, as in Hunt & Crossley, "Coefficient of restitution
    interpreted as damping in vibroimpact", J. Appl. Mech. 42 (1975): a constant damping would
    make the force jump at touch, and pull at parting.
    """
    depth = jnp.maximum(depth, 0.0)
    faded = damping * jnp.minimum(depth / FADE, 1.0)
    return jnp.maximum(stiffness * depth + faded * rate, 0.0)


def friction(stiffness: Array, damping: Array, deflection: Array, rate: Array,
             bound: Array) -> tuple[Array, Array]:  # fmt: skip
    """Tangential force [N] and the elastic deflection [m] that is left, by return mapping.

    The contact sticks by a spring from its anchor: a constant load below `bound` (friction
    coefficient times normal force) holds at a constant deflection for ever. Beyond the bound the
    anchor is dragged along so that the spring carries the bound exactly (elastic predictor and
    return mapping: Simo & Hughes, Computational Inelasticity, 1998, chapter 1; the contact model
    of Cundall & Strack, Géotechnique 29, 1979). Without contact the deflection is 0.
    """
    limit = bound / stiffness
    deflection = jnp.clip(deflection, -limit, limit)
    return jnp.clip(stiffness * deflection + damping * rate, -bound, bound), deflection
