"""What numbers and words a setting or an option may have, and how an error message says it."""

import math
from typing import Any, NamedTuple

LARGEST = 2**63 - 1
"""Of whole numbers, which count steps and entries of arrays."""


class Bounds(NamedTuple):
    """The values that are allowed; None: no such bound. Numbers must be finite in any case, whole ones up to `LARGEST`.

    Raised messages read `KEY=VALUE: must WORDS`.
    """

    least: float | None = None
    most: float | None = None
    above: float | None = None
    """Smaller than every allowed number."""
    choices: tuple[Any, ...] | None = None

    def admits(self, value: Any) -> bool:
        """Whether the value is allowed; it has the right type already."""
        if self.choices is not None:
            return value in self.choices
        if isinstance(value, int) and abs(value) > LARGEST:  # `isfinite` fails on integers that no float holds
            return False
        return (
            math.isfinite(value)
            and (self.least is None or value >= self.least)
            and (self.most is None or value <= self.most)
            and (self.above is None or value > self.above)
        )

    def words(self, noun: str = "") -> str:
        """What a value must be, for instance "be a whole number of at least 1".

        Args:
            noun: of the type, for instance "a whole number"; without it the words fit any number.
        """
        if self.choices is not None:
            return f"be one of {', '.join(map(str, self.choices))}"
        if self.least is not None and self.most is not None:
            return f"{f'be {noun} from' if noun else 'lie between'} {self.least} {'to' if noun else 'and'} {self.most}"
        if self.above == 0 and self.most is None:
            return f"be {noun.replace('a ', 'a positive ', 1)}" if noun else "be positive"
        if self.least == 0 and not noun:
            return "not be negative"
        lower = f"at least {self.least}" if self.least is not None else ""
        lower = f"more than {self.above}" if self.above is not None else lower
        upper = f"at most {self.most}" if self.most is not None else ""
        limits = " and ".join(part for part in (lower, upper) if part)
        return f"be {noun} of {limits}" if noun and limits else f"be {noun or limits or 'finite'}"
