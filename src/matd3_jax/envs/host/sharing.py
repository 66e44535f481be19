"""How the entries of an action vector are shared out among agents, and what of a robot is an agent's own."""

import re
from collections.abc import Sequence
from typing import Any

from matd3_jax.errors import OptionError, nearest

Shares = str | tuple[tuple[int, ...], ...]
"""A name, or the entries of each agent."""


def as_split(split: Any) -> Shares:
    """`split` as a hashable value. Raises OptionError for anything but a name and lists of entries."""
    if isinstance(split, str):
        return split
    if isinstance(split, Sequence) and all(isinstance(own, Sequence) and not isinstance(own, str) for own in split):
        return tuple(tuple(own) for own in split)
    raise OptionError(f"split={split!r}: must be single, halves, NxM, or one list of the action's entries per agent")


def share(split: Shares, size: int, model: Any) -> tuple[tuple[int, ...], ...]:
    """The entries of the action vector [size] that each agent has.

    Args:
        split: `single`; of a robot that this project knows by its joints (`envs.robots`) the name of one of its
            partitions; for others `halves`, or `NxM`, N agents with M entries each, one behind the other; or the
            entries of each agent.
        model: the robot's `mujoco.MjModel`; None: there is none.

    Raises OptionError where not every entry is exactly one agent's.
    """
    if split == "single":
        return (tuple(range(size)),)
    if isinstance(split, str):
        known = _known_splits(model)
        if split in known:
            return known[split]
        wanted = re.fullmatch(r"(\d+)x(\d+)", split)
        if split == "halves" and size % 2 == 0:
            count, width = 2, size // 2
        elif wanted and not known and int(wanted[1]) * int(wanted[2]) == size > 0:
            count, width = int(wanted[1]), int(wanted[2])
        else:
            names = [*known, "single", "halves"] if known else ["single", "halves", *_products(size)]
            raise OptionError(f"split={split!r}: an action has {size} entries; {nearest(split, set(names))}, or lists")
        return tuple(tuple(range(i * width, (i + 1) * width)) for i in range(count))
    entries = [entry for own in split for entry in own]
    if not all(split) or sorted(map(str, entries)) != sorted(map(str, range(size))):
        raise OptionError(
            f"split={[list(own) for own in split]}: each of the entries 0 to {size - 1} of an action must be exactly "
            "one agent's, and each agent have one"
        )
    return split


def own_entries(shares: Sequence[Sequence[int]], model: Any, skipped: int) -> tuple[tuple[int, ...], ...]:
    """Of an observation that begins with positions (without the first `skipped`) and velocities, the entries of each
    agent: position and velocity of the root and of its own joints."""
    from matd3_jax.envs.robots.partition.layout import lay_out

    tree = _tree(model)
    layout = lay_out(model.nq, model.nv, skipped)
    joints = {joint.actuator: joint for joint in tree.joints}
    found = []
    for own in shares:
        entries = [layout.entry("qpos", i) for i in tree.root_qpos] + [layout.entry("qvel", i) for i in tree.root_qvel]
        entries += [layout.entry("qpos", joints[i].qpos) for i in own]
        entries += [layout.entry("qvel", joints[i].qvel) for i in own]
        found.append(tuple(i for entry in entries for i in entry))
    return tuple(found)


def own_bodies(shares: Sequence[Sequence[int]], model: Any) -> tuple[tuple[int, ...], ...]:
    """The bodies that each agent moves (see `kinematic_tree.own_bodies`)."""
    from matd3_jax.envs.robots.partition import kinematic_tree

    tree = _tree(model)
    return tuple(kinematic_tree.own_bodies([j for j in tree.joints if j.actuator in own], tree) for own in shares)


def _known_splits(model: Any) -> dict[str, tuple[tuple[int, ...], ...]]:
    """The partitions of a robot that has the joints of one of ours."""
    if model is None:
        return {}
    from matd3_jax.envs.robots.partition.graphs import GRAPHS

    try:
        actuators = {joint.name: joint.actuator for joint in _tree(model).joints}
    except OptionError:
        return {}
    for graph in GRAPHS.values():
        first = next(iter(graph.splits.values()))
        if {name for own in first for name in own} == set(actuators):
            return {
                name: tuple(tuple(actuators[joint] for joint in own) for own in agents)
                for name, agents in graph.splits.items()
            }
    return {}


def _tree(model: Any) -> Any:
    from matd3_jax.envs.robots.partition.kinematic_tree import describe

    try:
        return describe(model)
    except (ValueError, KeyError, IndexError) as error:
        raise OptionError(f"observe=own: the robot's actuators do not move one joint each ({error})") from error


def _products(size: int) -> list[str]:
    return [f"{count}x{size // count}" for count in range(2, size + 1) if size % count == 0]
