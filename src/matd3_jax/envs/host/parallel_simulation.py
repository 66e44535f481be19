"""One copy of an environment with PettingZoo's parallel API, and what is to be known of it beforehand."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from matd3_jax.envs.host.pool import Outcome
from matd3_jax.envs.host.spaces import Actions, flat_size, flatten
from matd3_jax.errors import OptionError

LIMITS = ("max_cycles", "_max_episode_steps", "max_episode_steps", "episode_length", "max_steps")
"""Attributes in which environments keep after how many env steps they truncate."""


@dataclasses.dataclass(frozen=True)
class Facts:
    """What is known of an environment before it is played."""

    agents: tuple[str, ...]
    actions: tuple[Actions, ...]
    observations: tuple[Any, ...]
    """gymnasium's spaces."""
    sizes: tuple[int, ...]
    state: Any
    """The space of `state()`, or None where only its size is known."""
    state_size: int
    """0: there is no `state()`."""
    limit: int | None
    """Env steps after which it truncates, where it says so."""


def ask(env: Any, name: str) -> Facts:
    """What an environment is. It is reset once."""
    observations, infos = env.reset(seed=0)
    agents = tuple(map(str, getattr(env, "possible_agents", None) or env.agents))
    if any(isinstance(info, Mapping) and "action_mask" in info for info in dict(infos).values()):
        raise OptionError(f"{name} gives an action_mask, which is not supported: wrap it away")
    whose = [f"{agent!r} in {name}" for agent in agents]
    seen = tuple(env.observation_space(agent) for agent in agents)
    sizes = tuple(flat_size(space, who) for space, who in zip(seen, whose, strict=True))
    actions = tuple(Actions.of(env.action_space(agent), who) for agent, who in zip(agents, whose, strict=True))
    state, state_size = _state(env)
    return Facts(agents, actions, seen, sizes, state, state_size, _limit(env))


def _state(env: Any) -> tuple[Any, int]:
    """The space and the size of `state()`; (None, 0) where there is none."""
    try:
        found = env.state()
    except Exception:  # NotImplementedError, mostly: what the API says of environments without one
        return None, 0
    space = getattr(env, "state_space", None)
    if not (isinstance(space, spaces.Space) and space.is_np_flattenable and space.contains(found)):
        space = None
    return space, len(_flat_state(space, found))


def _flat_state(space: Any, found: Any) -> np.ndarray:
    return np.asarray(found, np.float32).ravel() if space is None else flatten(space, found)


def _limit(env: Any) -> int | None:
    layers = [env, getattr(env, "unwrapped", None), getattr(env, "single_agent_env", None)]
    for layer in [one for one in layers if one is not None]:
        for owner in (layer, getattr(layer, "spec", None)):
            for name in LIMITS:
                value = getattr(owner, name, None)
                if isinstance(value, int | np.integer) and not isinstance(value, bool) and value > 0:
                    return int(value)
    return None


class ParallelSimulation:
    """One copy of an environment with the parallel API."""

    def __init__(self, env: Any, facts: Facts):
        self.env, self.facts = env, facts
        self.observations: Mapping[str, Any] = {}
        self.left: dict[str, bool] = {}
        """Agents that are out of the episode, and whether they were truncated."""
        self.ends = np.cumsum([actions.width for actions in facts.actions])[:-1]

    def reset(self, seed: int) -> None:
        self.observations, _ = self.env.reset(seed=seed)
        self.left = {}

    def step(self, action: np.ndarray) -> Outcome:
        facts, env = self.facts, self.env
        parts = dict(zip(facts.agents, np.split(action, self.ends), strict=True))
        spaces_ = dict(zip(facts.agents, facts.actions, strict=True))
        before = list(env.agents)
        observations, rewards, terminations, truncations, _ = env.step(
            {agent: spaces_[agent].back(parts[agent]) for agent in before}
        )
        playing = [agent for agent in facts.agents if agent not in self.left]
        reward = np.array([rewards.get(a, 0.0) if a in playing else 0.0 for a in facts.agents], np.float32)
        self.observations = {agent: observations[agent] for agent in playing if agent in observations}
        present = set(env.agents)
        for agent in playing:
            truncated = bool(truncations.get(agent, False)) and not terminations.get(agent, False)
            if truncated or terminations.get(agent, False) or (agent in before and agent not in present):
                self.left[agent] = truncated
        ended = not any(agent not in self.left for agent in present)
        truncated = ended and any(self.left.values())
        return Outcome(reward, ended and not truncated, truncated)

    def seen(self) -> np.ndarray:
        facts, found = self.facts, []
        for agent, space, size in zip(facts.agents, facts.observations, facts.sizes, strict=True):
            there = agent in self.observations
            found.append(flatten(space, self.observations[agent]) if there else np.zeros(size, np.float32))
        if facts.state_size:
            found.append(_flat_state(facts.state, self.env.state()))
        return np.concatenate(found)

    def memory(self) -> Any:
        return self.env, self.observations, self.left

    def remember(self, memory: Any) -> None:
        self.env, self.observations, self.left = memory
