"""Slope of one quantity over another if both have errors beyond their known noise.

Errors of x flatten the line of y over x, those of y steepen that of x over y; the truth lies between (Frisch
1934, *Statistical Confluence Analysis*). The known noise of each is subtracted from its sum of squares. The
rest may belong to either: the slope is the geometric mean of the two extremes, and their distance is an
uncertainty that no number of samples, or of such slopes, reduces.
"""

from __future__ import annotations

import numpy as np


def slope_between(
    square_x: float, both: float, square_y: float, count: float, sds: tuple[float, float]
) -> tuple[float, float]:
    """Slope between the extremes that errors allow, and the root mean square distance of these from it.

    `square_x`, `square_y`, `both`: sums of squares and of products of `count` samples about their means, of
    positively correlated quantities; `sds`: known noise of x and of y. An x without significant variation is
    uninformative (infinite uncertainty); a y without it allows any slope that its noise could hide.
    """
    unsure = np.sqrt(2 / max(count, 1.0))  # relative standard error of a sum of squares of noise
    noise_x, noise_y = count * sds[0] ** 2, count * sds[1] ** 2
    true_x, true_y = square_x - noise_x, max(square_y - noise_y, 0.0)
    if true_x <= 2 * unsure * noise_x:
        return max(both / square_x, 0.0), np.inf
    flat = max(both / true_x, 0.0)
    middle, most = (float(np.sqrt(v / true_x)) for v in (true_y, true_y + noise_y * unsure))
    if most <= flat:
        return flat, 0.0
    # Correlation less its sampling error, as by chance errors of x may also look like those of y.
    share, chance = flat / most, 1 / np.sqrt(max(count, 1.0))
    share = min(max(share - chance * np.sqrt(1 - share**2), chance), 1.0)
    return max(middle, flat), most * float(np.hypot(1 - share, 1 / share - 1)) / np.sqrt(2.0)
