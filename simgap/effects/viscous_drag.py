"""A drag on the fingers in proportion to their velocity."""

from __future__ import annotations

from simgap.effects.base import HAND, Effect, Parameter, Performance, World, flat, tips, with_force, with_load


def _correct(world: World, values, on) -> World:
    _, velocity = tips(world)
    return with_load(world, values["coefficient"] * velocity)


def _apply(performance: Performance, values, rng) -> Performance:
    return with_force(
        performance, flat(performance) + values["coefficient"] * performance.velocity.reshape(-1, 4)
    )


EFFECT = Effect(
    name="viscous_drag",
    acts_on="dynamics",
    says="recorded F = F + coefficient v on each finger",
    shows="free motion too, by velocity",
    mistaken_for=("force_lag",),
    called="drag on the fingers as they move",
    check=(
        "Move the open hand back and forth at two speeds and watch the forces; look at bearings and sleeves."
    ),
    parameters=(Parameter("coefficient", "N s/m", 0.6),),
    stage=HAND,
    correct=_correct,
    apply=_apply,
)
