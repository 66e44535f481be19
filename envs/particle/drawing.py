"""The particle tasks as scenes on the plane."""

from collections import Counter

import numpy as np

from ..colours import DARK_GREY, GREEN, GREY, PURPLE, TEAM, Colour
from ..plane import Disc, Scene
from .task import ParticleTask
from .world import State


def scene(env: ParticleTask, states: State) -> Scene:
    """The episode of `states`, every leaf with a leading axis [frames].

    Landmarks are grey, the goal among them green and ringed; obstacles, which agents bump into, are dark. Who speaks
    has a bar for each entry of the message. In simple_crypto goal and key are codes: the entry that stands for the goal
    is green in everybody's message. Places mean nothing there: agents stand apart instead, and landmarks are left out.
    """
    world = env.world
    pos, landmark = np.asarray(states.pos), np.asarray(states.landmark)[0]
    comm = None if states.comm is None else np.asarray(states.comm)
    goal = None if states.goal is None else int(states.goal[0])
    discs, note = [], ""
    if states.key is None:
        for i, (radius, solid) in enumerate(zip(world.landmark_radius, world.landmark_collide, strict=True)):
            colour = GREEN if i == goal else DARK_GREY if solid else GREY
            discs.append(Disc(landmark[i], radius, colour, ringed=i == goal))
    else:
        angle = 2 * np.pi * np.arange(len(env.agents)) / len(env.agents) - np.pi / 2
        pos = np.broadcast_to(0.6 * np.stack([np.cos(angle), np.sin(angle)], axis=1), pos.shape)
        note = f"code to tell: {goal}, key: {int(states.key[0])}"
    for i, label in enumerate(_labels(env.agents)):
        message = None if comm is None or world.movable[i] else comm[:, i]
        marked = None if states.key is None else goal
        discs.append(Disc(pos[:, i], world.radius[i], TEAM[env.teams[i]], label, message=message, marked=marked))
    return Scene(discs, note)


def legend(env: ParticleTask) -> tuple[tuple[str, Colour], ...]:
    """(what, colour) of what a scene shows."""
    shown: dict[str, Colour] = {}
    for agent, team in zip(env.agents, env.teams, strict=True):
        shown[_kind(agent)] = TEAM[team]
    if env.num_goals:
        shown["code" if env.num_keys else "goal"] = GREEN
    world = env.world
    if any(world.landmark_collide):
        shown["obstacle"] = DARK_GREY
    elif world.landmark_radius and not env.num_keys:
        shown["landmark"] = GREY
    if env.dim_c:
        shown["message"] = PURPLE
    return tuple(shown.items())


def _kind(agent: str) -> str:
    return agent.rsplit("_", 1)[0]


def _labels(agents: tuple[str, ...]) -> list[str]:
    """Agents of one kind bear their numbers; who is known by name bears it; the only one of its colour bears none."""
    count = Counter(map(_kind, agents))
    return [
        _kind(agent)
        if _kind(agent) not in ("agent", "adversary")
        else agent.rsplit("_", 1)[1] * (count[_kind(agent)] > 1)
        for agent in agents
    ]
