"""Numbers and intervals as text."""

import numpy as np
import pytest

from matd3_jax.stats import text


@pytest.mark.parametrize(
    ("value", "words"),
    [(0.0, "0"), (-1.23456, "-1.235"), (999.94, "999.9"), (1234.5, "1,234"), (-98765.4, "-98,765"), (np.nan, "—")],
)
def test_numbers(value, words):
    assert text.number(value) == words
    assert text.ends(value, 2.0) == f"{words} to 2"


def test_a_mean_has_its_half_width_where_there_is_one():
    assert text.plus_minus(12.3456, 0.567) == "12.35 ± 0.57"
    assert text.plus_minus(12.3456, 0.567, "+.1f", ".1f") == "+12.3 ± 0.6"
    assert text.plus_minus(12.0, None) == text.plus_minus(12.0, np.nan) == "12"
    assert text.plus_minus(np.nan, np.nan) == "nan"
    assert text.ends(-427.6, 588.2, ".0f") == "-428 to 588"


def test_numbers_of_seeds():
    assert (text.seeds(1), text.seeds(2)) == ("one seed", "2 seeds")
