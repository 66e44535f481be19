"""Shares the actuators of a MuJoCo Playground robot out among agents, by their names and order."""

import re
from collections.abc import Callable, Sequence
from typing import Any

from matd3_jax.errors import OptionError, nearest

Split = str | tuple[tuple[str, ...], ...]
"""Name of a way to share out, or the names of each agent's actuators."""

_LEG = re.compile(
    r"^(?P<end>f|r|h)(?P<side>l|r)_|(?:^|_)(?P<long_end>front|fore|hind|rear|back)_(?P<long_side>left|right)(?:_|$)",
    re.IGNORECASE,
)
"""Go1: FR_hip; Spot: hl_kn; Barkour: abduction_front_left."""
_SIDE = re.compile(r"(?:^|_)(left|right|l|r)(?:_|$)", re.IGNORECASE)
"""G1: left_hip_pitch; OP3: l_sho_roll."""


def share_out(actuators: Sequence[str], split: Any) -> tuple[tuple[int, ...], ...]:
    """The actuators (their indices) of each agent.

    `split` is one of

    - `single`: one agent has all of them;
    - `halves`: two agents, by side where every other actuator is named for its side (those of neither side go with the
      first), or else the first and the second half;
    - `legs`: an agent for each leg, where every actuator is named for one (Go1, Spot, Barkour);
    - `NxM`: N agents with M actuators each, in their order;
    - the names of each agent's actuators.

    Raises OptionError for any other split, and where the actuators cannot be shared out like that.
    """
    everybody = tuple(range(len(actuators)))
    if not isinstance(split, str):
        return _named(actuators, split)
    if split == "single":
        return (everybody,)
    if split == "halves":
        return _halves(actuators)
    if split == "legs":
        return _grouped(actuators, _leg, "leg")
    pattern = re.fullmatch(r"(\d+)x(\d+)", split)
    if pattern is None:
        raise OptionError(f"split={split!r}: must be single, halves, legs, NxM (agents x actuators), or lists of names")
    agents, each = int(pattern[1]), int(pattern[2])
    if agents < 1 or agents * each != len(actuators):
        fitting = [f"{n}x{len(actuators) // n}" for n in range(1, len(actuators) + 1) if len(actuators) % n == 0]
        raise OptionError(f"split={split!r}: the robot has {len(actuators)} actuators; possible: {', '.join(fitting)}")
    return tuple(everybody[i * each : (i + 1) * each] for i in range(agents))


def as_split(split: Any) -> Split:
    """`split` as a hashable value. Raises OptionError where it is neither a word nor lists of names."""
    if isinstance(split, str):
        return split
    if isinstance(split, Sequence) and all(isinstance(own, Sequence) and not isinstance(own, str) for own in split):
        return tuple(tuple(map(str, own)) for own in split)
    raise OptionError(f"split={split!r}: must be single, halves, legs, NxM (agents x actuators), or lists of names")


def _named(actuators: Sequence[str], split: Sequence[Sequence[str]]) -> tuple[tuple[int, ...], ...]:
    given = [name for own in split for name in own]
    for name in given:
        if name not in actuators:
            raise OptionError(f"split: the robot has no actuator {name!r}; {nearest(name, actuators)}")
        if given.count(name) > 1:
            raise OptionError(f"split: actuator {name!r} is named twice")
    if left_out := [name for name in actuators if name not in given]:
        raise OptionError(f"split: no agent has {', '.join(map(repr, left_out))}")
    if not all(split):
        raise OptionError("split: an agent has no actuators")
    return tuple(tuple(actuators.index(name) for name in own) for own in split)


def _halves(actuators: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    if len(actuators) < 2:
        raise OptionError(f"split='halves': the robot has one actuator, {actuators[0]!r}; take split=single")
    sides = [_side(name) for name in actuators]
    named = list(dict.fromkeys(side for side in sides if side is not None))
    if len(named) < 2:
        middle = len(actuators) // 2
        return tuple(range(middle)), tuple(range(middle, len(actuators)))
    second = tuple(i for i, side in enumerate(sides) if side == named[1])
    return tuple(i for i in range(len(actuators)) if i not in second), second


def _grouped(actuators: Sequence[str], group: Callable[[str], str | None], noun: str) -> tuple[tuple[int, ...], ...]:
    members: dict[str, list[int]] = {}
    for i, name in enumerate(actuators):
        found = group(name)
        if found is None:
            raise OptionError(
                f"split='{noun}s': the actuator {name!r} is named for no {noun}; take NxM or lists of names"
            )
        members.setdefault(found, []).append(i)
    return tuple(map(tuple, members.values()))


def _leg(name: str) -> str | None:
    found = _LEG.search(name)
    if found is None:
        return None
    end = (found["end"] or found["long_end"])[0].lower()
    return end + (found["side"] or found["long_side"])[0].lower()


def _side(name: str) -> str | None:
    leg = _leg(name)
    found = _SIDE.search(name)
    return leg[1] if leg is not None else found[1][0].lower() if found is not None else None
