"""Contact that is not tidy: what hands do beside the task, put into the operator's commands.

`tap`: touching before gripping; `push`: a shove along the support before lifting; `still`: ten seconds
held in the air; `hesitate`: pauses within a motion; `slip`: the grip loosens for a moment while carrying;
`table`: a fingertip on the table before the grip. Fingers that close apart and blocks that turn are
circumstances of any world (worlds.py).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from experiments.blind_check.operator import Knots, Style

KINDS = ("tap", "push", "still", "hesitate", "slip", "table")
STILL = 10.0  # s
LOOSE = (0.04, 0.07)  # s for which a grip loosens


def before_grip(k: Knots, style: Style, height: float, pace: float) -> None:
    """On the way down to a block: a pause, or down to the table and up again."""
    u = k.rng.uniform
    if "hesitate" in style.untidy:
        k.to(0.3 / pace, y=height + u(0.004, 0.01))
        k.wait(u(0.3, 0.8))
    if "table" in style.untidy and height < 0.012:
        k.to(0.5 / pace, y=0.0055)
        k.wait(u(0.1, 0.3))


def tap(k: Knots, style: Style, width: float, wide: float, inwards: float, pace: float) -> None:
    """A light touch that is given up before the grip."""
    if "tap" in style.untidy:
        k.fingers(0.2 / pace, width - 2 * inwards * k.rng.uniform(0.15, 0.4))
        k.wait(k.rng.uniform(0.02, 0.12))
        k.fingers(0.15 / pace, width + (wide - width) * k.rng.uniform(0.3, 0.7))
        k.wait(k.rng.uniform(0.1, 0.3))


def held_on_ground(k: Knots, style: Style) -> None:
    """A shove along the support, as one who looks for a better hold gives."""
    if "push" in style.untidy:
        x = k.value["x"]
        k.to(0.25, x=x + k.rng.choice([-1, 1]) * k.rng.uniform(0.002, 0.004))
        k.wait(k.rng.uniform(0.15, 0.3))


def carried(k: Knots, style: Style, width: float, inwards: float) -> None:
    """In the air: ten seconds of stillness, a pause, or a grip that loosens and holds again."""
    u = k.rng.uniform
    if "still" in style.untidy:
        k.wait(STILL)
    if "hesitate" in style.untidy:
        k.wait(u(0.2, 0.6))
    if "slip" in style.untidy:
        k.wait(0.3)
        k.fingers(0.05, width - 2 * inwards * u(0.15, 0.25))
        k.wait(u(*LOOSE))
        k.fingers(0.05, width - 2 * inwards)
        k.wait(0.3)
