"""The dynamics against closed forms, conservation laws and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from simgap_scenes import FAR, at, evolve, scene, tips

from simgap.world.dynamics import energy, interact, normal_force
from simgap.world.properties import Block
from simgap.world.virtual_model import rollout

G = 9.80665


def test_a_drop_falls_as_galileo_says_and_a_block_slides_with_the_closed_form_acceleration():
    constants = scene()
    fall = evolve(constants, at(constants, (0.0, 0.018)), FAR, 2.5e-4, 8000)
    t = 2.5e-4 * np.arange(1, 8001)
    before = t < np.sqrt(2 * 0.01 / G)
    np.testing.assert_allclose(fall.y[0][before], 0.018 - G * t[before] ** 2 / 2, atol=1e-12)
    assert float(fall.y[0][-1]) == pytest.approx(0.008 - 0.4 / 1e5, abs=1e-9)
    assert float(fall.vy[0][-1]) == pytest.approx(0.0, abs=1e-9)
    tilt = float(np.arctan(1.5 * 0.5))
    constants = scene(tilt=tilt)
    path = evolve(constants, at(constants, (0.0, 0.008)), FAR, 2.5e-4, 4000)
    speed, expected = np.hypot(path.vx[0], path.vy[0]), G * (np.sin(tilt) - 0.5 * np.cos(tilt))
    assert float(speed[-1] - speed[1999]) / (2000 * 2.5e-4) == pytest.approx(expected, rel=1e-3)


def oscillation(pad_time: float, h: float, end: float = 0.02) -> float:
    """Error of a gripped block's swing against the damped spring's closed form, at the end [m]."""
    constants = scene(pad_time=pad_time)
    mass, start = 0.4 / G, 1e-4
    state = at(constants, (start, 0.03))
    state = state._replace(vy=(jnp.asarray(0.0),))
    fingers = tips(-0.01 + 5e-4, 0.03, 0.01 - 5e-4, 0.03)
    path = evolve(constants, state, fingers, h, round(end / h))
    k, c = 8000.0, 8000.0 * pad_time
    rate = c / (2 * mass)
    w = np.sqrt(k / mass - rate**2)
    exact = start * np.exp(-rate * end) * (np.cos(w * end) + rate / w * np.sin(w * end))
    return float(path.x[0][-1]) - exact


def test_a_spring_converges_at_second_order_and_a_damped_one_at_first_or_better():
    errors = np.abs([oscillation(0.0, h) for h in (4e-4, 2e-4, 1e-4, 5e-5)])
    orders = np.log2(errors[:-1] / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.1)
    assert errors[-1] < 1e-7
    errors = np.abs([oscillation(5e-4, h) for h in (2e-4, 1e-4, 5e-5)])
    assert (np.log2(errors[:-1] / errors[1:]) > 0.9).all() and errors[-1] < 2e-6


@pytest.mark.parametrize("share", [0.5, 0.99])
def test_a_block_sticks_on_an_incline_below_the_angle_of_friction(share):
    tilt = float(np.arctan(share * 0.5))
    constants, height = scene(tilt=tilt), 0.008 / np.cos(tilt)
    path = evolve(constants, at(constants, (0.0, height - 2e-6)), FAR, 2.5e-4, 40000)
    settled = path.x[0][4000:]
    assert float(jnp.ptp(settled)) < 1e-9  # ten seconds, no creep


def test_energy_is_kept_by_an_undamped_bounce_and_never_made_by_contact():
    constants, spread = scene(support_damping=0.0), []
    for h in (1e-4, 5e-5, 2.5e-5):
        path = evolve(constants, at(constants, (0.0, 0.0085)), FAR, h, round(2.0 / h))
        held = jax.vmap(lambda s: energy(constants, s, FAR))(path)
        spread.append(float(jnp.ptp(held)) / (0.4 * 0.0005))  # over a hundred bounces
    assert spread[0] < 0.05 and spread[1] < spread[0] / 3 and spread[2] < spread[1] / 3
    constants = scene([Block(0.4, 0.02, 0.016), Block(0.3, 0.025, 0.012)])
    path = evolve(constants, at(constants, (0.0, 0.035), (0.004, 0.0065)), FAR, 5e-5, 20000)
    held = np.asarray(jax.vmap(lambda s: energy(constants, s, FAR))(path))
    lost = held[0] - held[-1]
    assert lost > 0.4 * 0.014  # the upper block fell that far and rests
    # Within an impact the scheme's energy swings by the square of the step; none is left over.
    assert (held - np.minimum.accumulate(held)).max() < 0.02 * lost
    assert (held[::500] - np.minimum.accumulate(held[::500])).max() < 1e-4 * lost


def test_stacks_stay_and_blocks_that_meet_in_the_air_keep_their_momentum():
    constants = scene([Block(0.4, 0.02, 0.016), Block(0.3, 0.02, 0.016)])
    state = at(constants, (-0.015, 1.0), (0.015, 1.0))
    state = state._replace(vx=(jnp.asarray(0.3), jnp.asarray(-0.2)))
    path = evolve(constants, state, FAR, 2.5e-4, 400)
    momentum = (0.4 * path.vx[0] + 0.3 * path.vx[1]) / G
    np.testing.assert_allclose(momentum, momentum[0], atol=1e-15)
    assert float(path.vx[0][-1]) < 0.3 - 0.05  # they did meet
    assert float(path.x[1][-1] - path.x[0][-1]) > 0.0199  # and did not pass through
    blocks = [Block(0.3, 0.018, 0.016), Block(0.6, 0.025, 0.013), Block(0.4, 0.02, 0.018)]
    constants = scene(blocks)
    path = evolve(constants, at(constants, (0.003, 0.039), (0.0, 0.0245), (-0.002, 0.009)), FAR, 2.5e-4,
                  40000)  # fmt: skip
    for k in range(3):
        assert float(jnp.ptp(path.x[k])) < 1e-12 and float(jnp.ptp(path.y[k][8000:])) < 1e-10
    assert float(path.y[0][-1]) == pytest.approx(0.039 - (1.3 + 0.9 + 0.3) / 1e5, abs=1e-8)


def test_a_held_block_neither_sinks_nor_turns_loose_and_slides_in_too_weak_a_grip():
    constants = scene()
    fingers = tips(-0.01 + 5e-4, 0.03, 0.01 - 5e-4, 0.03)
    path = evolve(constants, at(constants, (0.0, 0.03)), fingers, 2.5e-4, 40000)
    assert float(path.y[0][-1]) == pytest.approx(0.03 - 0.4 / 5000, abs=1e-9)
    assert float(jnp.ptp(path.y[0][4000:])) < 1e-9
    constants = scene([Block(0.4, 0.02, 0.016, friction=0.1)])
    fingers = tips(-0.01 + 2.5e-4, 0.03, 0.01 - 2.5e-4, 0.03)  # 1 N of grip carries 0.2 N
    path = evolve(constants, at(constants, (0.0, 0.03)), fingers, 2.5e-4, 100)
    rate = float(path.vy[0][99] - path.vy[0][59]) / (40 * 2.5e-4)
    assert rate == pytest.approx(-G * (0.4 - 0.2) / 0.4, rel=1e-3)


def grasp_and_lift(weight, width, stiffness):
    constants = scene()._replace(weight=(weight,), width=(width,), pad_normal=(stiffness, stiffness))
    t = jnp.arange(400.0) * 1e-3
    close = 0.01203 - 0.0026 * jnp.clip(t / 0.1, 0, 1)
    lift = 0.008 + 0.004 * jnp.clip((t - 0.15) / 0.1, 0, 1) - 0.0042 * jnp.clip((t - 0.28) / 0.1, 0, 1)
    position = jnp.stack([jnp.stack([-close, lift], -1), jnp.stack([close, lift], -1)], 1)
    velocity = jnp.gradient(position, 1e-3, axis=0)
    return rollout(constants, at(constants, (0.0, 0.008)), position, velocity, 1e-3, 4).force


def test_gradients_through_contact_agree_with_differences_and_are_finite_at_touch():
    point = [jnp.asarray(0.4), jnp.asarray(0.02), jnp.asarray(4000.0)]
    loss = jax.jit(lambda *properties: jnp.sum(grasp_and_lift(*properties) ** 2) / 400)
    exact = jax.grad(loss, argnums=(0, 1, 2))(*point)
    for k, value in enumerate(exact):
        h = 1e-7 * float(point[k])
        up, down = ([p + sign * h if k == j else p for j, p in enumerate(point)] for sign in (1.0, -1.0))
        assert np.isfinite(value) and value != 0.0
        assert float(value) == pytest.approx(float(loss(*up) - loss(*down)) / (2 * h), rel=1e-4)
    constants = scene()
    state = at(constants, (0.0, 0.008))  # resting at depth 0, tips at depth 0

    def total(weight, x):
        fingers = tips(-0.01, 0.008, 0.01, 0.008)._replace(x=(-x, x))
        _, loads = interact(constants._replace(weight=(weight,)), state, fingers)
        return loads.fx[0] + loads.block_y[0]

    for value in jax.grad(total, argnums=(0, 1))(jnp.asarray(0.4), jnp.asarray(0.01)):
        assert np.isfinite(value)


@pytest.mark.parametrize(("depth", "rate", "force"), [(1e-3, 0.0, 4.0), (1e-3, 0.1, 4.8), (-1e-3, 5.0, 0.0),
                                                      (1e-3, -5.0, 0.0)])  # fmt: skip
def test_a_spring_pushes_by_its_compression_and_never_pulls(depth, rate, force):
    found = normal_force(*map(jnp.asarray, (4000.0, 8.0, depth, rate)))
    assert float(found) == pytest.approx(force)
