"""What property tests share: how many examples, and texts as people, files and fuzzers have them."""

import os

from hypothesis import Phase, settings
from hypothesis import strategies as st


def examples(count: int) -> settings:
    """So many examples: the same ones every time where CI is set, new ones elsewhere. One that fails is shown as it is:
    to make it smaller may take minutes."""
    phases = (Phase.explicit, Phase.generate)
    return settings(
        max_examples=count, deadline=None, derandomize="CI" in os.environ, database=None, phases=phases,
        report_multiple_bugs=False,
    )  # fmt: skip


GRAMMAR = "0123456789.,:;=+-_eE[]{}()<>'\"\\$~!#%&*/|@^?\n\r\t \x00abcnul\u00e9\u0661\u2028\ud800\udcff"
"""Letters that parsers of settings, YAML, numbers and paths treat in ways of their own."""

numbers = st.one_of(st.integers().map(str), st.floats().map(repr), st.integers(0, 100).map(str))

words = st.sampled_from(
    ["null", "true", "false", "nan", "inf", "1e6", "0x10", "1_000", "${seed}", "matd3", "..", "~", ""]
)

texts = st.one_of(
    st.text(GRAMMAR, max_size=12),
    st.text(max_size=8),
    numbers,
    words,
    st.lists(st.one_of(numbers, words), max_size=4).map(lambda parts: f"[{','.join(parts)}]"),
)
