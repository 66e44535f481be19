"""JaxMARL's calling convention (`MultiAgentEnv` of FLAIROx/JaxMARL) for any environment here; needs no JaxMARL."""

import dataclasses
from functools import partial
from typing import Any

import chex
import jax

from matd3_jax.envs.environment import Environment
from matd3_jax.envs.spaces import ActionSpace, Box


@dataclasses.dataclass(frozen=True)
class JaxMARL:
    """`env` with observations, actions, rewards and dones as dictionaries keyed by agent.

    `step` resets by itself when an episode ends, as JaxMARL's does: observation and state are then those of the new
    episode. `step_env` does not reset. `infos` of both hold what JaxMARL has no place for: "terminated" and
    "truncated" (boolean scalars) and "final_observation" (per agent, before any reset). All pure and jit-compiled.
    """

    env: Environment

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

    def observation_space(self, agent: str) -> Box:
        """Unbounded box. Raises KeyError for an unknown agent."""
        return Box(self._by_agent(self.env.observation_sizes)[agent])

    def action_space(self, agent: str) -> ActionSpace:
        """A space with `shape` and `sample(key)`. Raises KeyError for an unknown agent."""
        return self._by_agent(self.env.action_spaces)[agent]

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

    def _by_agent(self, items: tuple) -> dict[str, Any]:
        return dict(zip(self.env.agents, items, strict=True))
