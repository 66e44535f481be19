"""Where each physical quantity stands in a robot's full observation."""

import dataclasses
from collections.abc import Iterable, Sequence

_WIDTHS = {"cinert": 10, "cvel": 6, "cfrc_ext": 6}  # numbers per body


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where each quantity stands in a robot's full observation; None or beyond the end: it is not observed."""

    size: int
    """Entries of the full observation."""
    qpos: tuple[int | None, ...]
    """Entry of each generalized position."""
    qvel: tuple[int | None, ...]
    """Entry of each generalized velocity (degree of freedom)."""
    cinert: tuple[int | None, ...] = ()
    """First of the 10 entries (inertia about the center of mass) of each body, the world being body 0."""
    cvel: tuple[int | None, ...] = ()
    """First of the 6 entries (velocity at the center of mass) of each body."""
    qfrc_actuator: tuple[int | None, ...] = ()
    """Entry of the actuators' force on each degree of freedom."""
    cfrc_ext: tuple[int | None, ...] = ()
    """First of the 6 entries (external torque and force) of each body."""

    def entry(self, name: str, index: int) -> tuple[int, ...]:
        """All entries of the quantity `name` (a field's) at `index`: none where it is not observed."""
        offsets = getattr(self, name)
        first = offsets[index] if index < len(offsets) else None
        return () if first is None else tuple(range(first, first + _WIDTHS.get(name, 1)))


def lay_out(
    num_qpos: int,
    num_qvel: int,
    hidden: int,
    cinert: Sequence[int] = (),
    cvel: Sequence[int] = (),
    qfrc_actuator: Sequence[int] = (),
    cfrc_ext: Sequence[int] = (),
    velocities: bool = True,
) -> Layout:
    """The layout of qpos[hidden:], qvel, cinert, cvel, qfrc_actuator, cfrc_ext, one behind the other.

    `cinert`, `cvel`, `cfrc_ext`: bodies shown, `qfrc_actuator`: degrees of freedom shown, in their order. `velocities`:
    whether qvel and cvel are shown at all.
    """
    end = 0

    def place(shown: Iterable[int], width: int = 1) -> tuple[int | None, ...]:
        nonlocal end
        first = {item: end + width * k for k, item in enumerate(shown)}
        end += width * len(first)
        return tuple(first.get(item) for item in range(max(first, default=-1) + 1))

    return Layout(
        qpos=place(range(hidden, num_qpos)),
        qvel=place(range(num_qvel) if velocities else ()),
        cinert=place(cinert, _WIDTHS["cinert"]),
        cvel=place(cvel if velocities else (), _WIDTHS["cvel"]),
        qfrc_actuator=place(qfrc_actuator),
        cfrc_ext=place(cfrc_ext, _WIDTHS["cfrc_ext"]),
        size=end,
    )
