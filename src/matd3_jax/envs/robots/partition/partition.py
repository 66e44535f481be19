"""Shares a robot's joints out among agents: who moves what, and who sees what."""

import dataclasses
from collections.abc import Sequence
from typing import Any

from matd3_jax.envs.environment import check_count
from matd3_jax.envs.robots.partition.graphs import GRAPHS, Graph
from matd3_jax.envs.robots.partition.kinematic_tree import Joint, KinematicTree, describe, own_bodies
from matd3_jax.envs.robots.partition.layout import Layout, lay_out
from matd3_jax.errors import OptionError, nearest

__all__ = [
    "KinematicTree",
    "Layout",
    "Partition",
    "Split",
    "as_split",
    "default_split",
    "describe",
    "lay_out",
    "partition",
]

Split = str | tuple[tuple[str, ...], ...]
"""Name of a partition, or the partition itself: the names of each agent's joints."""


@dataclasses.dataclass(frozen=True)
class Partition:
    """Who moves and sees what; one entry per agent in each tuple."""

    agents: tuple[str, ...]
    """Names."""
    joints: tuple[tuple[str, ...], ...]
    """Names of the agent's joints, in the order of its action vector."""
    actuators: tuple[tuple[int, ...], ...]
    """Index of the robot's control for each entry of the agent's action."""
    observations: tuple[tuple[int, ...], ...]
    """Indices into the full observation."""
    bodies: tuple[tuple[int, ...], ...]
    """The robot's bodies that are the agent's own, ascending: see `own_bodies`."""


def as_split(split: Any) -> Split:
    """`split` as a hashable value: a name, or tuples of joint names. Raises OptionError for anything else."""
    if isinstance(split, str):
        return split
    if isinstance(split, Sequence) and all(
        isinstance(agent, Sequence) and not isinstance(agent, str) for agent in split
    ):
        return tuple(tuple(str(joint) for joint in agent) for agent in split)
    raise OptionError(f"split={split!r}: must be the name of a partition or one list of joint names per agent")


def default_split(robot: str) -> str:
    """Name of the partition that `robot` has by default: `halves` for ant, MaMuJoCo's first for others."""
    return next(iter(GRAPHS[robot].splits))


def partition(robot: str, tree: KinematicTree, layout: Layout, split: Any, depth: int | None = None) -> Partition:
    """Share the joints of `robot` (a key of `graphs.GRAPHS`) out among agents agent_0, agent_1, ...

    `split` is one of

    - the name of a partition: `halves` (ant: the left and the right two legs, as in the MATD3 paper), or MaMuJoCo's
      `2x4`, `2x4d`, `4x2` (ant), `2x3`, `6x1` (half_cheetah), `3x1` (hopper), `2x3` (walker2d), `9|8` (humanoid),
      `2x1` (swimmer);
    - `single`: one agent that sees the full observation and acts through all controls in their order;
    - for any other partition, the names of each agent's joints, in the order of its actions. Every actuated joint
      belongs to exactly one agent.

    `depth` says what an agent sees:

    - a number: what MaMuJoCo shows with `agent_obsk=depth`, in the same order. Of the agent's own joints position and
      velocity, and what the robot observes of bodies next to them and of actuator forces; of joints up to `depth` steps
      away in the joint graph the position; lastly position and velocity of the root.
    - None: for MaMuJoCo's partitions depth 1, as there; for `halves` and own partitions the paper's observation:
      position and velocity of the root; positions, velocities, and (where the robot observes them) inertias,
      velocities, actuator forces and external forces of the own joints and bodies; positions of all other joints.

    An agent's entries are a selection from the full observation, clipped where that is clipped. MaMuJoCo reads them
    from the simulator instead and differs in one place: it does not clip the velocities of walker2d, which the full
    observation clips to [-10, 10]. It shows a body's quantities with every joint next to it, hence the torso's with
    every hip and shoulder; the paper's observation has none of the torso's.

    Raises OptionError for an unknown split or joint, a joint without or with two agents, an agent without joints, and
    an impossible depth.
    """
    graph, split = GRAPHS[robot], as_split(split)
    if depth is not None:
        check_count("depth", depth, 0)
    if split == "single":
        if depth is not None:
            raise OptionError(f"depth={depth}: split='single' sees everything; leave depth at None")
        owned = [sorted(tree.joints, key=lambda joint: joint.actuator)]
        observations: list[tuple[int, ...]] = [tuple(range(layout.size))]
    else:
        owned = _assign(robot, graph, tree, split)
        if depth is None and (split == "halves" or not isinstance(split, str)):
            observations = [_paper_observation(joints, tree, layout) for joints in owned]
        else:
            steps = 1 if depth is None else depth
            observations = [_neighborhood_observation(joints, graph, tree, layout, steps) for joints in owned]
    return Partition(
        agents=tuple(f"agent_{i}" for i in range(len(owned))),
        joints=tuple(tuple(joint.name for joint in joints) for joints in owned),
        actuators=tuple(tuple(joint.actuator for joint in joints) for joints in owned),
        observations=tuple(observations),
        bodies=tuple(own_bodies(joints, tree) for joints in owned),
    )


def _assign(robot: str, graph: Graph, tree: KinematicTree, split: Split) -> list[list[Joint]]:
    """The joints of each agent."""
    joints = {joint.name: joint for joint in tree.joints}
    if isinstance(split, str):
        if split not in graph.splits:
            known = (*graph.splits, "single")
            raise OptionError(f"split={split!r}: {robot} has no such partition; {nearest(split, known)}")
        return [[joints[name] for name in agent] for agent in graph.splits[split]]
    if not split:
        raise OptionError("split=(): name the joints of at least one agent")
    seen: set[str] = set()
    for i, agent in enumerate(split):
        if not agent:
            raise OptionError(f"split: agent {i} has no joints")
        for name in agent:
            if name not in joints:
                raise OptionError(f"split: {robot} has no actuated joint {name!r}; {nearest(name, joints)}")
            if name in seen:
                raise OptionError(f"split: joint {name!r} is named twice")
            seen.add(name)
    if left_out := [name for name in joints if name not in seen]:
        raise OptionError(f"split: no agent has {', '.join(map(repr, left_out))}")
    return [[joints[name] for name in agent] for agent in split]


def _paper_observation(own: Sequence[Joint], tree: KinematicTree, layout: Layout) -> tuple[int, ...]:
    bodies = own_bodies(own, tree)
    entries = [layout.entry("qpos", i) for i in tree.root_qpos]
    entries += [layout.entry("qvel", i) for i in tree.root_qvel]
    entries += [layout.entry("qpos", joint.qpos) for joint in own]
    entries += [layout.entry("qvel", joint.qvel) for joint in own]
    entries += [layout.entry("cinert", body) for body in bodies]
    entries += [layout.entry("cvel", body) for body in bodies]
    entries += [layout.entry("qfrc_actuator", joint.qvel) for joint in own]
    entries += [layout.entry("cfrc_ext", body) for body in bodies]
    entries += [layout.entry("qpos", joint.qpos) for joint in tree.joints if joint not in own]
    return tuple(i for entry in entries for i in entry)


def _neighborhood_observation(
    own: Sequence[Joint], graph: Graph, tree: KinematicTree, layout: Layout, depth: int
) -> tuple[int, ...]:
    def label(joint: Joint) -> str:
        return graph.labels.get(joint.name, joint.name)

    by_name = {joint.name: joint for joint in tree.joints}
    entries: list[tuple[int, ...]] = []
    shown: set[int] = set()  # bodies adjoin several joints
    for joint in sorted(own, key=label):
        root = graph.root_velocity.get(joint.name)
        bodies = [body for body in graph.bodies.get(joint.name, ()) if body not in shown]
        shown.update(bodies)
        entries.append(layout.entry("qpos", joint.qpos))
        entries += [layout.entry("qvel", i) for i in (root, joint.qvel) if i is not None]
        entries += [layout.entry("cinert", body) for body in bodies]
        entries += [layout.entry("cvel", body) for body in bodies]
        entries.append(layout.entry("qfrc_actuator", joint.qvel))
        entries += [layout.entry("cfrc_ext", body) for body in bodies]
    reached = frontier = {joint.name for joint in own}
    for _ in range(depth):
        if not frontier:
            break
        frontier = {name for edge in graph.edges if not frontier.isdisjoint(edge) for name in edge} - reached
        reached = reached | frontier
        entries += [layout.entry("qpos", joint.qpos) for joint in sorted((by_name[n] for n in frontier), key=label)]
    entries += [layout.entry("qpos", i) for i in tree.root_qpos]
    entries += [layout.entry("qvel", i) for i in tree.root_qvel if i not in graph.root_velocity.values()]
    return tuple(i for entry in entries for i in entry)
