"""JaxMARL's calling convention (`MultiAgentEnv` of bold-lab-ai/JaxMARL) for any environment here; needs no JaxMARL."""

import dataclasses
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp

from matd3_jax.envs.environment import Environment
from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, MultiDiscrete, Simplex
from matd3_jax.interop.import_jaxmarl import import_jaxmarl


@dataclasses.dataclass(frozen=True)
class JaxMARL:
    """`env` with observations, actions, rewards and dones as dictionaries keyed by agent.

    `step` resets by itself when an episode ends, as JaxMARL's does: observation and state are then those of the new
    episode. `step_env` does not reset. `infos` of both hold what JaxMARL has no place for: "terminated" and
    "truncated" (boolean scalars) and "final_observation" (per agent, before any reset). All pure and jit-compiled.

    `infos` are not one number for each agent: where an algorithm of JaxMARL reshapes them like that, wrap this in its
    `LogWrapper(env, replace_info=True)`. Some of its code asks whether a space is one of its own classes
    (`CTRolloutManager`, for its Q-learning): `own_spaces=True` gives those, and needs JaxMARL; soft choices (Simplex)
    are a Box from 0 to 1 there.

    Example:
        >>> from matd3_jax import envs
        >>> env = JaxMARL(envs.make("simple_spread", actions="discrete"))
        >>> observations, state = env.reset(jax.random.key(0))
        >>> actions = {agent: env.action_space(agent).sample(jax.random.key(1)) for agent in env.agents}
        >>> observations, state, rewards, dones, infos = env.step(jax.random.key(2), state, actions)
        >>> observations["agent_0"].shape, bool(dones["__all__"])
        ((18,), False)
    """

    env: Environment
    own_spaces: bool = False

    @property
    def name(self) -> str:
        return type(self.env).__name__

    @property
    def agents(self) -> list[str]:
        return list(self.env.agents)

    @property
    def num_agents(self) -> int:
        return len(self.env.agents)

    @property
    def agent_classes(self) -> dict[str, list[str]]:
        """Agents of each team."""
        classes: dict[str, list[str]] = {}
        for agent, team in zip(self.env.agents, self.env.teams, strict=True):
            classes.setdefault(team, []).append(agent)
        return classes

    @property
    def observation_spaces(self) -> dict[str, Any]:
        """Unbounded boxes."""
        return {a: self._space(Box(size)) for a, size in self._by_agent(self.env.observation_sizes).items()}

    @property
    def action_spaces(self) -> dict[str, Any]:
        """Spaces with `shape` and `sample(key)`, Discrete with `n`."""
        return {agent: self._space(space) for agent, space in self._by_agent(self.env.action_spaces).items()}

    def observation_space(self, agent: str) -> Any:
        """Unbounded box. Raises KeyError for an unknown agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """A space with `shape` and `sample(key)`. Raises KeyError for an unknown agent."""
        return self.action_spaces[agent]

    def get_avail_actions(self, state: Any) -> dict[str, chex.Array]:
        """For each agent with choices a one for each of them: all are available."""
        del state
        spaces = self._by_agent(self.env.action_spaces)
        return {a: jnp.ones(space.size) for a, space in spaces.items() if isinstance(space, Discrete | MultiDiscrete)}

    @partial(jax.jit, static_argnums=0)
    def reset(self, key: chex.PRNGKey) -> tuple[dict[str, chex.Array], Any]:
        """(observations, state) of a new episode."""
        state, observation = self.env.reset(key)
        return self._by_agent(observation), state

    @partial(jax.jit, static_argnums=0)
    def step(
        self, key: chex.PRNGKey, state: Any, actions: dict[str, chex.Array], reset_state: Any | None = None
    ) -> tuple[dict[str, chex.Array], Any, dict[str, chex.Array], dict[str, chex.Array], dict[str, Any]]:
        """(observations, state, rewards, dones, infos); when all are done from `reset_state`, or from a reset."""
        key, key_reset = jax.random.split(key)
        observation, stepped, rewards, dones, infos = self.step_env(key, state, actions)
        if reset_state is None:
            fresh_observation, fresh = self.reset(key_reset)
        else:
            fresh_observation, fresh = self.get_obs(reset_state), reset_state
        done = dones["__all__"]
        observation, state = jax.tree.map(
            lambda new, old: jax.lax.select(done, new, old), (fresh_observation, fresh), (observation, stepped)
        )
        return observation, state, rewards, dones, infos

    @partial(jax.jit, static_argnums=0)
    def step_env(
        self, key: chex.PRNGKey, state: Any, actions: dict[str, chex.Array]
    ) -> tuple[dict[str, chex.Array], Any, dict[str, chex.Array], dict[str, chex.Array], dict[str, Any]]:
        """As `step`, without the reset."""
        ts = self.env.step(key, state, tuple(actions[agent] for agent in self.env.agents))
        observation = self._by_agent(ts.observation)
        done = ts.terminated | ts.truncated
        dones = self._by_agent((done,) * self.num_agents) | {"__all__": done}
        infos = {"terminated": ts.terminated, "truncated": ts.truncated, "final_observation": observation}
        return observation, ts.state, self._by_agent(tuple(ts.reward)), dones, infos

    def get_obs(self, state: Any) -> dict[str, chex.Array]:
        """Observations in `state`."""
        return self._by_agent(self.env.observe(state))

    def _space(self, space: ActionSpace) -> Any:
        if not self.own_spaces:
            return space
        spaces = import_jaxmarl("own_spaces=True").environments.spaces
        if isinstance(space, Discrete):
            return spaces.Discrete(space.n)
        if isinstance(space, MultiDiscrete):
            return spaces.MultiDiscrete(space.sizes)
        low, high = (0.0, 1.0) if isinstance(space, Simplex) else (space.low, space.high)
        return spaces.Box(low, high, space.shape)

    def _by_agent(self, items: tuple) -> dict[str, Any]:
        return dict(zip(self.env.agents, items, strict=True))
