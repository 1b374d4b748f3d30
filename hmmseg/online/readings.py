"""From one row of channels to what the emissions score: kinematics, short means, slopes, ranges.

Everything looks back only. A reading is the mean of the last WINDOW s, as recordings are read off line;
the vertical acceleration is the slope of the velocity over the last SLOPE s, and a velocity that is not
measured the difference to the row before.
"""

from __future__ import annotations

import math

from hmmseg.online.compiled import compiled
from hmmseg.online.layout import (
    AY,
    FX1,
    FY1,
    FY2,
    LAST_D,
    LAST_FY,
    LAST_Y,
    SD_D,
    SD_VX,
    SD_VY,
    SD_Y,
    VX,
    VY,
    D,
    T,
    Y,
)
from hmmseg.segmentation.emissions import MAX_RATE, WINDOW

SLOPE = 1.0 / MAX_RATE
ROWS = 512  # numerics: rows looked back at, at most: 20 kHz over SLOPE
NUM_MEANS = 8  # numerics: forces, vx, vy, y, d
HISTORY = 4 + NUM_MEANS  # numerics: of a row: time, reach that scales noise (2), values, net vertical mean


@compiled
def hand_row(channels, jointed, geometry, velocities, before, dt, out):
    """Task-space values of one row: forces (4), vx, vy, y, d, and the reach that scales noise (4).

    `channels` (12,): q11, q12, dq11, dq12, fx1, fy1, q21, ..., or x1, y1, vx1, vy1, ...; `geometry` (8,):
    bases and links of both fingers; `velocities`: whether a Cartesian hand measures them; `before` (12,):
    the row before, `dt` [s] ago. `out` (12,).
    """
    x, y, vx, vy = 0.0, 0.0, 0.0, 0.0
    distance = 0.0
    for k in range(4):
        out[8 + k] = 0.0
    for i in range(2):
        at = 6 * i
        out[2 * i], out[2 * i + 1] = channels[at + 4], channels[at + 5]
        if jointed:
            tip_x, tip_y = geometry[4 * i], geometry[4 * i + 1]
            tip_vx = tip_vy = 0.0
            for j in range(2):
                link, q, dq = geometry[4 * i + 2 + j], channels[at + j], channels[at + 2 + j]
                across, along = link * math.cos(q), link * math.sin(q)
                tip_x, tip_y = tip_x + across, tip_y + along
                tip_vx, tip_vy = tip_vx - along * dq, tip_vy + across * dq
                out[8] += along * along / 2  # of one finger's x, then y
                out[9] += across * across / 2
        else:
            tip_x, tip_y = channels[at], channels[at + 1]
            if velocities:
                tip_vx, tip_vy = channels[at + 2], channels[at + 3]
            else:
                tip_vx, tip_vy = (tip_x - before[at]) / dt, (tip_y - before[at + 1]) / dt
        x, y, vx, vy = x + tip_x / 2, y + tip_y / 2, vx + tip_vx / 2, vy + tip_vy / 2
        distance += tip_x if i else -tip_x
    if not jointed:
        out[8] = out[9] = 1.0
    out[4], out[5], out[6], out[7] = vx, vy, y, distance


@compiled
def read(history, head, filled, t, dt, row, noise, velocities, x):
    """The reading (NUM_READ,) at `t` from the rows so far.

    `history` (ROWS, 12) is a ring with its newest row at `head`;
    `noise` (2,): squared noise of one position and of one velocity [rad or m, and per s]; `dt` [s] since
    the row before.
    """
    x[LAST_Y], x[LAST_D] = x[Y], x[D]
    there = history[head]
    there[0], there[1], there[2] = t, row[8], row[9]
    for k in range(NUM_MEANS):
        there[3 + k] = row[k]
        x[FX1 + k if k < 6 else (Y if k == 6 else D)] = 0.0
    x[LAST_FY] = math.nan
    number = 0
    for k in range(NUM_MEANS):
        total, num = 0.0, 0
        for back in range(filled):
            old = history[(head - back) % ROWS]
            if back > 0 and old[0] <= t - WINDOW + 1e-9:
                break
            if not math.isnan(old[3 + k]):
                total += old[3 + k]
                num += 1
            if k == 0:
                number += 1
        x[FX1 + k if k < 6 else (Y if k == 6 else D)] = total / num if num > 0 else math.nan
    there[11] = x[FY1] + x[FY2]
    number = max(number, 1)
    sum_t = sum_v = sum_tt = sum_tv = 0.0
    num = 0
    for back in range(filled):
        old = history[(head - back) % ROWS]
        if back > 1 and old[0] < t - SLOPE - 1e-9:
            break
        if back > 0:
            x[LAST_FY] = old[11]
        if not math.isnan(old[8]):
            age = old[0] - t
            sum_t, sum_v, num = sum_t + age, sum_v + old[8], num + 1
            sum_tt, sum_tv = sum_tt + age * age, sum_tv + age * old[8]
    spread = num * sum_tt - sum_t * sum_t
    x[AY] = (num * sum_tv - sum_t * sum_v) / spread if num > 1 and spread > 0.0 else math.nan
    x[T] = t
    # One finger's noise is `reach` times the joints'; y and velocities are means of both, d the difference.
    share = 1.0 / (2 * number)
    x[SD_Y] = math.sqrt(noise[0] * row[9] * share)
    x[SD_D] = 2 * math.sqrt(noise[0] * row[8] * share)
    velocity = noise[1] if velocities else 2 * noise[0] / max(dt * dt * number, 1e-12)
    x[SD_VX] = math.sqrt(velocity * row[8] * share)
    x[SD_VY] = math.sqrt(velocity * row[9] * share)


@compiled
def widen(extremes, spans, least, x):
    """Ranges that the emissions take as possible, so far and not below `least` (4,)."""
    for k in range(4):
        value = x[VX] if k == 0 else (x[VY] if k == 1 else (x[Y] if k == 2 else x[D]))
        if not math.isnan(value):
            extremes[k, 0], extremes[k, 1] = min(extremes[k, 0], value), max(extremes[k, 1], value)
            spans[k] = max(least[k], extremes[k, 1] - extremes[k, 0])
    for c in range(4):
        if not math.isnan(x[FX1 + c]):
            spans[4] = max(spans[4], 1.5 * abs(x[FX1 + c]))
    if not math.isnan(x[FY1] + x[FY2]):
        spans[5] = max(spans[5], 1.5 * abs(x[FY1] + x[FY2]))
