"""Numbers for readers: a value with its uncertainty, in one unit per quantity, without exponents."""

from __future__ import annotations

import math

# By SI unit, the factor to the unit shown, and its name.
UNITS = {
    "m": (1e3, "mm"),
    "rad": (1e3, "mrad"),
    "s": (1e3, "ms"),
    "kg": (1e3, "g"),
    "N s": (1e3, "mN s"),
    "1": (1.0, ""),
}
# The same by property of a block, as in the paper.
SHOWN = {"weight": (1.0, "N"), "width": (100.0, "cm"), "height": (100.0, "cm"), "friction": (1.0, "")}
MOST = 6  # look: decimals shown


def shown_as(unit: str, share: bool = False) -> tuple[float, str]:
    """Factor to the unit in which an SI unit is shown, and its name; a dimensionless `share` in per cent."""
    return (100.0, "%") if share and unit in ("", "1") else UNITS.get(unit, (1.0, unit))


def property_shown_as(name: str, unit: str) -> tuple[float, str]:
    """The same for a property, "block1.width" or "width"; for others by their unit."""
    return SHOWN.get(name.rpartition(".")[2], shown_as(unit))


def plain(value: float, digits: int = 3) -> str:
    """A number with `digits` significant digits, without an exponent: 3985, 0.0123, 12.4."""
    if not math.isfinite(value):
        return "infinite" if value > 0 else "-infinite" if value < 0 else "none"
    if value == 0:
        return "0"
    places = min(12, max(0, digits - 1 - math.floor(math.log10(abs(value)))))
    return f"{value:.{places}f}"


def fixed(value: float, places: int, sign: str = "") -> str:
    """With this number of decimals, never as -0; `sign` "+" shows the sign of positive numbers too."""
    return f"{0.0 if round(value, places) == 0 else value:{sign}.{places}f}"


def _places(error: float) -> int:
    """Decimals that show two significant digits of an error; none if it is ten or more."""
    return min(MOST, max(0, 1 - math.floor(math.log10(error))))


def estimate(mean: float, sd: float, shown: tuple[float, str] = (1.0, "")) -> str:
    """`3985 ± 180 N/m`: two significant digits of the uncertainty, and the value with as many decimals."""
    factor, name = shown
    value, error = mean * factor, abs(sd * factor)
    if not math.isfinite(error) or error == 0 or not math.isfinite(value):
        return f"{plain(value)} {name}".rstrip()
    places = _places(error)
    rounded = error if places else float(f"{error:.2g}")
    return f"{fixed(value, places)} ± {rounded:.{places}f} {name}".rstrip()


def interval(low: float, high: float, shown: tuple[float, str] = (1.0, ""), sds: float = 3.3) -> str:
    """`3690 to 4280 N/m`: both ends with the decimals of the estimate between them.

    `sds`: standard deviations between the ends, 3.3 for 90 %.
    """
    factor, name = shown
    a, b = low * factor, high * factor
    if not (math.isfinite(a) and math.isfinite(b)) or a == b:
        return f"{plain(a)} to {plain(b)} {name}".rstrip()
    places = _places(abs(b - a) / sds)
    return f"{fixed(a, places)} to {fixed(b, places)} {name}".rstrip()


def percent(share: float) -> str:
    """A share as a whole percentage, "under 1 %" or "over 99 %" instead of a rounded 0 or 100."""
    value = 100 * share
    if 0 < value < 0.5:
        return "under 1 %"
    if 99.5 <= value < 100:
        return "over 99 %"
    return f"{fixed(value, 0)} %"


def between(low: float | None, high: float | None) -> str:
    """An interval of a share, "62 to 78 %"; empty if it is unknown or vanishes in rounding."""
    if low is None or high is None or round(100 * low) == round(100 * high):
        return ""
    return f"{fixed(100 * low, 0)} to {fixed(100 * high, 0)} %"
