"""Small environments with JaxMARL's methods, for what JaxMARL's own do not show; they need no JaxMARL."""

import types
from typing import NamedTuple

import jax
import jax.numpy as jnp


class State(NamedTuple):
    position: jax.Array
    step: jax.Array


class Line:
    """Two agents on a line, each moved by two numbers; it ends beyond 3, or after `max_steps`."""

    agents = ["left", "adversary_right"]

    def __init__(self, max_steps=5, low=(-1.0, 0.0), high=(1.0, 4.0)):
        self.max_steps, self.low, self.high = max_steps, jnp.array(low), jnp.array(high)

    def action_space(self, agent):
        return types.SimpleNamespace(low=self.low, high=self.high, shape=(2,))

    def observe(self, state):
        return {agent: state.position[i : i + 1] for i, agent in enumerate(self.agents)}

    def reset(self, key):
        state = State(jnp.zeros(2), jnp.array(0))
        return self.observe(state), state

    def step_env(self, key, state, actions):
        moved = jnp.stack([actions[agent].sum() for agent in self.agents])
        state = State(state.position + moved, state.step + 1)
        done = (jnp.abs(state.position) > 3).any() | (state.step >= self.max_steps)
        dones = dict.fromkeys([*self.agents, "__all__"], done)
        return self.observe(state), state, {a: moved[i] for i, a in enumerate(self.agents)}, dones, {}


class Endless(Line):
    """Without a time limit."""

    def __init__(self):
        super().__init__(max_steps=2**31 - 1)
        del self.max_steps

    def step_env(self, key, state, actions):
        self.max_steps = 2**31 - 1
        found = super().step_env(key, state, actions)
        del self.max_steps
        return found


class Images(Line):
    """Its observations are pictures of whole numbers, its global state comes with them."""

    def observe(self, state):
        pictures = {a: jnp.full((2, 3), state.step, jnp.uint8) for a in self.agents}
        return pictures | {"world_state": state.position}
