"""One copy of an environment of gymnasium, and what is to be known of it beforehand."""

import dataclasses
from typing import Any

import numpy as np

from matd3_jax.envs.host.pool import Outcome
from matd3_jax.envs.host.spaces import Actions, flat_size, flatten

VELOCITY = "x_velocity"
"""What gymnasium's walking robots call their speed in the information of a step."""


@dataclasses.dataclass(frozen=True)
class Facts:
    """What is known of an environment before it is played."""

    action: Actions
    observation: Any
    """gymnasium's space."""
    size: int
    limit: int | None
    """Env steps after which it truncates."""
    model: Any
    """`mujoco.MjModel` of a robot; None of others."""
    skipped: int | None
    """Positions that the observation leaves out where it begins with positions and velocities; None: it does not."""
    speed: bool
    """Whether steps tell a forward velocity."""


def ask(env: Any, name: str) -> Facts:
    """What an environment is. It is reset, and stepped once."""
    actions = Actions.of(env.action_space, name)
    size = flat_size(env.observation_space, name)
    observation, _ = env.reset(seed=0)
    model = getattr(getattr(env, "unwrapped", env), "model", None)
    data = getattr(getattr(env, "unwrapped", env), "data", None)
    if not (hasattr(model, "nq") and hasattr(model, "actuator_trnid") and hasattr(data, "qpos")):
        model, skipped = None, None
    else:
        skipped = _skipped(flatten(env.observation_space, observation), data)
    spec = getattr(env, "spec", None)
    limit = getattr(spec, "max_episode_steps", None)
    *_, info = env.step(actions.back(np.zeros(actions.width, np.int32)))
    return Facts(actions, env.observation_space, size, limit, model, skipped, VELOCITY in info)


def _skipped(observation: np.ndarray, data: Any) -> int | None:
    """How many positions an observation leaves out that begins with the others and all velocities."""
    for skipped in range(data.qpos.size):
        begin = np.concatenate([data.qpos[skipped:], data.qvel]).astype(np.float32)
        if len(observation) >= len(begin) and np.array_equal(observation[: len(begin)], begin):
            return skipped
    return None


class SingleSimulation:
    """One copy of a gymnasium environment."""

    def __init__(self, env: Any, facts: Facts):
        self.env, self.facts = env, facts
        self.observation: Any = None
        self.speed = 0.0

    def reset(self, seed: int) -> None:
        self.observation, _ = self.env.reset(seed=seed)
        self.speed = 0.0

    def step(self, action: np.ndarray) -> Outcome:
        played = self.facts.action.back(action)
        self.observation, reward, terminated, truncated, info = self.env.step(played)
        self.speed = float(info.get(VELOCITY, 0.0))
        return Outcome(np.array([reward], np.float32), bool(terminated), bool(truncated))

    def seen(self) -> np.ndarray:
        facts = self.facts
        parts = [flatten(facts.observation, self.observation)]
        if facts.speed:
            parts.append(np.array([self.speed], np.float32))
        if facts.model is not None:
            parts.append(np.asarray(self.env.unwrapped.data.qpos, np.float32))
        return np.concatenate(parts)

    def memory(self) -> Any:
        return self.env, self.observation, self.speed

    def remember(self, memory: Any) -> None:
        self.env, self.observation, self.speed = memory
