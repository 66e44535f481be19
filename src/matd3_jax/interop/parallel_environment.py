"""An environment here as PettingZoo's `ParallelEnv`; made by `interop.to_pettingzoo.parallel_env`."""

import secrets
from typing import Any

import gymnasium
import jax
import numpy as np
from pettingzoo import ParallelEnv

from matd3_jax.envs.environment import Environment
from matd3_jax.errors import UserError, nearest
from matd3_jax.interop.gymnasium_spaces import action_space, as_ours, observation_space


class ParallelEnvironment(ParallelEnv):
    """`env` stepped through PettingZoo's parallel interface, one compiled program a step.

    All agents act until the episode ends for all of them; `agents` is empty then. `terminations` and `truncations` are
    the environment's own. Actions are elements of gymnasium's spaces (`interop.gymnasium_spaces`); soft choices are
    those of `SimplexSpace`. `state()` is `Environment.full_observation`. `render()` returns a picture of the present
    state, uint8 [height, width, 3], where `render_mode` is "rgb_array".

    `reset(seed=S)` starts the episode, and all further ones, that the key of S leads to; without a seed the next one of
    the same sequence, which in a new object starts at random. Options of `reset` are not used.
    """

    def __init__(self, env: Environment, render_mode: str | None = None, size: int = 400):
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode={render_mode!r}: must be 'rgb_array' or None")
        self.env, self.render_mode, self.size = env, render_mode, size
        self._drawing: Any = None
        self.metadata = {"name": type(env).__name__, "render_modes": ["rgb_array"], "is_parallelizable": True}
        if render_mode is not None:
            from matd3_jax.video import frames

            self._drawing = frames.drawing_of(env)
            self.metadata["render_fps"] = self._drawing.fps
        self.possible_agents = list(env.agents)
        self.agents: list[str] = []
        self.observation_spaces = dict(zip(env.agents, map(observation_space, env.observation_sizes), strict=True))
        self.action_spaces = dict(zip(env.agents, map(action_space, env.action_spaces), strict=True))
        self.state_space = observation_space(env.full_observation_size)
        self._key: Any = None
        self._state: Any = None
        self._reset = jax.jit(self._reset_with)
        self._step = jax.jit(self._step_with)
        self._full = jax.jit(env.full_observation)

    def observation_space(self, agent: str) -> gymnasium.Space:
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.Space:
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """(observations, infos) of a new episode."""
        if seed is not None or self._key is None:
            self._key = jax.random.key(secrets.randbits(31) if seed is None else seed)
        self._key, self._state, observation = self._reset(self._key)
        self.agents = list(self.possible_agents)
        return self._by_agent(jax.device_get(observation)), self._infos()

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """(observations, rewards, terminations, truncations, infos). Raises UserError where an agent does not act."""
        if not self.agents:
            raise UserError("step: the episode is over; call reset first")
        for agent in self.possible_agents:
            if agent not in actions:
                raise UserError(f"step: no action for {agent!r}; {nearest(agent, map(str, actions))}")
        taken = tuple(
            as_ours(space, actions[agent]) for agent, space in zip(self.env.agents, self.env.action_spaces, strict=True)
        )
        self._key, self._state, *shown = self._step(self._key, self._state, taken)
        observation, reward, terminated, truncated = jax.device_get(shown)
        terminations = dict.fromkeys(self.possible_agents, bool(terminated))
        truncations = dict.fromkeys(self.possible_agents, bool(truncated))
        if terminated or truncated:
            self.agents = []
        rewards = dict(zip(self.possible_agents, map(float, reward), strict=True))
        return self._by_agent(observation), rewards, terminations, truncations, self._infos()

    def state(self) -> np.ndarray:
        """The full observation, float32 [full_observation_size]. Raises UserError before the first reset."""
        return np.asarray(self._full(self._started("state")), np.float32)

    def render(self) -> np.ndarray | None:
        """The present state, uint8 [height, width, 3]; None without a render mode."""
        if self._drawing is None:
            return None
        from matd3_jax.video import frames

        selected = self._drawing.select(self._started("render"))
        (picture,) = frames.compose(self._drawing, jax.tree.map(lambda leaf: leaf[None], selected), None, self.size)
        return np.asarray(picture)

    def close(self) -> None:
        """Nothing is kept open."""

    def _started(self, what: str) -> Any:
        if self._state is None:
            raise UserError(f"{what}: call reset first")
        return self._state

    def _reset_with(self, key: Any) -> Any:
        key, now = jax.random.split(key)
        return key, *self.env.reset(now)

    def _step_with(self, key: Any, state: Any, action: tuple) -> Any:
        key, now = jax.random.split(key)
        ts = self.env.step(now, state, action)
        return key, ts.state, ts.observation, ts.reward, ts.terminated, ts.truncated

    def _by_agent(self, observation: tuple) -> dict[str, np.ndarray]:
        return {a: np.asarray(o, np.float32) for a, o in zip(self.possible_agents, observation, strict=True)}

    def _infos(self) -> dict[str, dict[str, Any]]:
        return {agent: {} for agent in self.possible_agents}
