"""Lists on the command line: `A,B` or `[A,B]`, of words as they are typed."""

import re

from matd3_jax.errors import UserError

_WORD = re.compile(r"""\s*(?:"([^"]*)"|'([^']*)'|([^,]*))\s*(,|$)""")
"""What stands between commas, or in quotation marks."""


def split(text: str) -> list[str]:
    """The words of `A,B` or `[A,B]`, empty ones too; a word in quotation marks keeps its commas and brackets.

    Raises UserError where a word begins with a quotation mark and does not end with it.
    """
    inside = text.strip()
    inside = inside[1:-1] if inside.startswith("[") and inside.endswith("]") else inside
    found, end = [], 0
    while True:
        match = _WORD.match(inside, end)
        assert match is not None  # the last alternative takes everything up to a comma
        double, single, bare, comma = match.groups()
        if bare is not None and bare[:1] in ("'", '"') and bare:
            raise UserError(f"cannot read {text!r}: a quotation mark is missing")
        found.append(next(word for word in (double, single, bare) if word is not None).strip())
        end = match.end()
        if not comma:
            return found


def words(text: str) -> list[str]:
    """`split` without empty words. Raises UserError as `split` does."""
    return [word for word in split(text) if word]
