"""The particle tasks as scenes on the plane."""

from collections import Counter

import numpy as np

from matd3_jax.envs.particle.task import ParticleTask
from matd3_jax.envs.particle.world import State
from matd3_jax.figures.style import DARK_GREY, GREEN, GREY, PALE_GREEN, PURPLE, TEAM, YELLOW, Color
from matd3_jax.video.plane import Disc, Scene

LANDMARK: dict[str, Color] = {
    "landmark": GREY,
    "obstacle": DARK_GREY,
    "goal": GREEN,
    "food": YELLOW,
    "forest": PALE_GREEN,
}


def scene(env: ParticleTask, states: State) -> Scene:
    """The episode of `states`, every leaf with a leading axis [frames].

    Landmarks are grey, the goal among them green and ringed; obstacles, which agents bump into, are dark, food is
    yellow, forests, under everything else, are pale green. Who speaks has a bar for each entry of the message. In
    simple_reference each goal bears the numbers of those that should go there. In simple_crypto goal and key are codes:
    the entry that stands for the goal is green in everybody's message. Places mean nothing there: agents stand apart
    instead, and landmarks are left out.
    """
    world = env.world
    pos, landmark = np.asarray(states.pos), np.asarray(states.landmark)[0]
    comm = None if states.comm is None else np.asarray(states.comm)
    goals = [] if states.goal is None else np.atleast_1d(np.asarray(states.goal[0])).tolist()
    discs, note = [], ""
    if states.key is None:
        kinds = ["goal" if i in goals else kind for i, kind in enumerate(env.landmark_kinds)]
        for i in sorted(range(len(kinds)), key=lambda i: -world.landmark_radius[i]):
            # Two goals: each is its owner's word to the other one.
            label = " ".join(str(1 - k) for k in (1, 0) if goals[k] == i) if env.goal_shape else ""
            discs.append(Disc(landmark[i], world.landmark_radius[i], LANDMARK[kinds[i]], label, kinds[i] == "goal"))
    else:
        angle = 2 * np.pi * np.arange(len(env.agents)) / len(env.agents) - np.pi / 2
        pos = np.broadcast_to(0.6 * np.stack([np.cos(angle), np.sin(angle)], axis=1), pos.shape)
        note = f"code to send: {goals[0]}, key: {int(states.key[0])}"
    for i, label in enumerate(_labels(env.agents)):
        message = None if comm is None or not env.speaks[i] else comm[:, i]
        marked = None if states.key is None else goals[0]
        discs.append(Disc(pos[:, i], world.radius[i], TEAM[env.teams[i]], label, message=message, marked=marked))
    return Scene(discs, note)


def legend(env: ParticleTask) -> tuple[tuple[str, Color], ...]:
    """(what, color) of what a scene shows."""
    shown: dict[str, Color] = {}
    for agent, team in zip(env.agents, env.teams, strict=True):
        shown[_kind(agent)] = TEAM[team]
    if env.num_goals:
        shown["code" if env.num_keys else "goal"] = GREEN
    if not env.num_keys:
        shown |= {kind: LANDMARK[kind] for kind in env.landmark_kinds}
    if env.dim_c:
        shown["message"] = PURPLE
    return tuple(shown.items())


def _kind(agent: str) -> str:
    kind = agent.rsplit("_", 1)[0]
    return "leader" if kind == "leadadversary" else kind


def _labels(agents: tuple[str, ...]) -> list[str]:
    """Agents of one kind bear their numbers; who is known by name bears it; the only one of its color bears none."""
    count = Counter(map(_kind, agents))
    return [
        _kind(agent)
        if _kind(agent) not in ("agent", "adversary")
        else agent.rsplit("_", 1)[1] * (count[_kind(agent)] > 1)
        for agent in agents
    ]
