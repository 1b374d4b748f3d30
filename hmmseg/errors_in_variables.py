"""The slope of one quantity over another where both may err by more than is known of them.

Errors of x make the line of y over x flat, those of y make that of x over y steep; the truth lies between
(Frisch 1934, *Statistical Confluence Analysis*). What is known of either's noise is taken out of its squares.
What is left over may be of one or of the other: the slope amid them is their geometric mean, and how far
they are apart is doubt that no number of samples, or of such slopes, takes away.
"""

from __future__ import annotations

import numpy as np


def slope_between(
    square_x: float, both: float, square_y: float, count: float, sds: tuple[float, float]
) -> tuple[float, float]:
    """The slope amid those that errors allow, and how far they lie from it (root mean square).

    `square_x`, `square_y`, `both`: sums of squares and of products of `count` samples, about their means, of
    quantities that grow together; `sds`: known noise of x and of y. An x that does not move for sure tells
    nothing (an infinite doubt); a y that does not leaves open any slope that its noise could hide.
    """
    unsure = np.sqrt(2 / max(count, 1.0))  # relative error of a sum of squares of noise
    noise_x, noise_y = count * sds[0] ** 2, count * sds[1] ** 2
    true_x, true_y = square_x - noise_x, max(square_y - noise_y, 0.0)
    if true_x <= 2 * unsure * noise_x:
        return max(both / square_x, 0.0), np.inf
    flat = max(both / true_x, 0.0)
    middle, most = (float(np.sqrt(v / true_x)) for v in (true_y, true_y + noise_y * unsure))
    if most <= flat:
        return flat, 0.0
    # Their correlation, less its own sampling error: by chance too, errors of x look like those of y.
    share, chance = flat / most, 1 / np.sqrt(max(count, 1.0))
    share = min(max(share - chance * np.sqrt(1 - share**2), chance), 1.0)
    return max(middle, flat), most * float(np.hypot(1 - share, 1 / share - 1)) / np.sqrt(2.0)
