"""What is said with exported policies: whose they are, and what their observations and actions mean."""

import inspect
from collections.abc import Sequence
from typing import Any

import matd3_jax
from matd3_jax.envs.environment import Environment
from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, MultiDiscrete, Simplex
from matd3_jax.envs.wrappers.joint_team import JointTeam, innermost
from matd3_jax.training.session import TrainingSession


def facts(training: TrainingSession, seed: int, step: int, which: str) -> dict[str, Any]:
    """Of all that is exported, its agents without the names of their files.

    Args:
        seed: its number.
        step: env step at which the policies were kept.
        which: "best evaluation" or "checkpoint".
    """
    env, base = training.env, innermost(training.env)
    names, actions = env.observation_names, env.action_names
    agents = []
    for i, agent in enumerate(env.agents):
        size, space = env.observation_sizes[i], env.action_spaces[i]
        agents.append(
            {
                "name": agent,
                "team": env.teams[i],
                "observation": {
                    "name": "observation", "shape": ["batch", size], "dtype": "float32", "range": "unbounded",
                    "normalized": "inside the policy" if training.config.normalize_observations else "not at all",
                    "entries": None if names is None else list(names[i]),
                    **_places(env, base, i),
                },
                "action": {
                    "name": "action", **_space(space),
                    "entries": None if actions is None else list(actions[i]),
                    **_controls(base, agent, i, joined=env is not base),
                },
                **_members(env, i),
            }
        )  # fmt: skip
    return {
        "made_by": f"matd3_jax {matd3_jax.__version__}",
        "policy": "deterministic, as evaluations play it: no noise, averaged actors where there are any",
        "kept_at": which,
        "step": step,
        "seed": seed,
        "environment": {**training.config.env, "about": inspect.getdoc(type(base)) or ""},
        "settings": training.config.to_dict(),
        "agents": agents,
        **_robot(base),
    }


def _space(space: ActionSpace) -> dict[str, Any]:
    """Shape, type and meaning of an action."""
    if isinstance(space, Box):
        return {
            "kind": "real numbers", "shape": ["batch", space.size], "dtype": "float32",
            "low": space.low, "high": space.high,
        }  # fmt: skip
    if isinstance(space, Simplex):
        meaning = "probabilities; those of each choice add up to 1, and the environment takes them as they are"
        return {
            "kind": meaning, "shape": ["batch", space.size], "dtype": "float32", "sizes": list(space.sizes),
        }  # fmt: skip
    shape: list[str | int] = ["batch"] if isinstance(space, Discrete) else ["batch", len(space.sizes)]
    assert isinstance(space, Discrete | MultiDiscrete)
    meaning = "the number of the likeliest option, of each choice; probabilities of all options are a second output"
    return {"kind": meaning, "shape": shape, "dtype": "int32", "sizes": list(space.sizes)}


def _places(env: Environment, base: Any, agent: int) -> dict[str, Any]:
    """Where a robot's agent finds its observation in the full one."""
    partition = getattr(base, "partition", None)
    if partition is None:
        return {}
    if env is base:
        return {"indices_in_full_observation": list(partition.observations[agent])}
    if isinstance(env, JointTeam) and not env.full:
        return {"indices_in_full_observation": [entry for one in partition.observations for entry in one]}
    return {"indices_in_full_observation": list(range(base.full_observation_size))}


def _controls(base: Any, agent: str, number: int, joined: bool) -> dict[str, Any]:
    """Which of a robot's controls an agent's action is."""
    partition = getattr(base, "partition", None)
    if partition is None:
        return {}
    own: Sequence[int] = partition.actuators[number] if not joined else [a for one in partition.actuators for a in one]
    return {"indices_of_controls": list(own)}


def _members(env: Environment, agent: int) -> dict[str, Any]:
    """Whom an agent stands for that acts for its whole team, and whose entries come one after the other."""
    while isinstance(env, JointTeam):
        if agent == env.members[0]:
            spaces = [env.env.action_spaces[i] for i in env.members]
            sizes = [1 if isinstance(space, Discrete) else space.shape[0] for space in spaces]
            return {"members": [env.env.agents[i] for i in env.members], "members_action_sizes": sizes}
        others = [i for i in range(len(env.env.agents)) if i not in env.members or i == env.members[0]]
        agent, env = others[agent], env.env
    return {}


def _robot(base: Any) -> dict[str, Any]:
    """A robot's controls in their order, and its full observation."""
    if getattr(base, "partition", None) is None:
        return {}
    from matd3_jax.envs.robots import names

    return {
        "robot": {
            "controls": list(names.actuators(base.mj_model)),
            "full_observation": list(base.full_observation_names),
        }
    }
