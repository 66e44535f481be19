"""Numbers and their intervals as text, for terminals, tables and figures."""

import numpy as np

NOTHING = "—"
"""In a table, where there is no number."""


def number(value: float) -> str:
    """Write four significant digits, thousands in full."""
    if np.isnan(value):
        return NOTHING
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def plus_minus(
    mean: float | np.ndarray, half: float | np.ndarray | None, form: str = ".4g", half_form: str = ".2g"
) -> str:
    """Write a mean with the half width of its interval (or its standard deviation), or alone where that is nan or None.

    Args:
        form, half_form: format specifications of the two numbers.
    """
    text = f"{mean:{form}}"
    return text if half is None or np.isnan(half) else f"{text} ± {half:{half_form}}"


def ends(low: float, high: float, form: str | None = None) -> str:
    """Write the ends of an interval.

    Args:
        form: format specification; default: as `number` writes them.
    """
    return " to ".join(number(end) if form is None else f"{end:{form}}" for end in (float(low), float(high)))


def seeds(count: int) -> str:
    """Write a number of seeds."""
    return f"{count} seeds" if count > 1 else "one seed"
