import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simgap.world.dynamics import FADE, friction, normal_force

K, C = jnp.asarray(4000.0), jnp.asarray(8.0)


def f(value: float) -> jax.Array:
    return jnp.asarray(value)


def test_a_spring_pushes_by_its_compression_and_never_pulls():
    assert float(normal_force(K, C, f(1e-3), f(0.0))) == pytest.approx(4.0)
    assert float(normal_force(K, C, f(1e-3), f(0.1))) == pytest.approx(4.8)
    assert float(normal_force(K, C, f(-1e-3), f(5.0))) == 0.0
    assert float(normal_force(K, C, f(1e-3), f(-5.0))) == 0.0


def test_force_and_slope_are_continuous_enough_at_touch():
    depths = jnp.linspace(-2 * FADE, 2 * FADE, 4001)
    forces = jax.vmap(lambda d: normal_force(K, C, d, f(0.1)))(depths)
    assert float(jnp.abs(jnp.diff(forces)).max()) < 1.1 * (4000 + 8 * 0.1 / FADE) * (4 * FADE / 4000)
    slopes = jax.vmap(jax.grad(lambda d: normal_force(K, C, d, f(0.1))))(depths)
    assert bool(jnp.isfinite(slopes).all())
    assert np.isfinite(jax.grad(lambda d: normal_force(K, C, d, f(0.1)))(f(0.0)))


def test_friction_sticks_below_the_cone_without_creeping():
    deflection = f(2e-4)
    for _ in range(100):
        force, deflection = friction(f(2500.0), f(5.0), deflection, f(0.0), f(1.0))
    assert float(deflection) == 2e-4
    assert float(force) == pytest.approx(0.5)


def test_friction_slips_at_the_cone_and_lets_go_without_load():
    force, deflection = friction(f(2500.0), f(5.0), f(1e-3), f(0.01), f(1.0))
    assert float(force) == 1.0
    assert float(deflection) == pytest.approx(1.0 / 2500)
    force, deflection = friction(f(2500.0), f(5.0), f(-1e-3), f(-0.01), f(0.0))
    assert float(force) == 0.0
    assert float(deflection) == 0.0
