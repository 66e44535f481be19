"""simple_crypto (Covert Communication): Alice tells Bob a code over an open line, with a key that Eve lacks."""

import dataclasses

import chex
import jax.numpy as jnp

from matd3_jax.envs.particle.task import ParticleTask
from matd3_jax.envs.particle.world import State, World, one_hot

EVE, BOB, ALICE = 0, 1, 2
NUM_CODES = 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimpleCrypto(ParticleTask):
    """Eve (adversary), Bob and Alice, who all speak and cannot move. Goal and key: one of two one-hot codes each.

    Observation of Eve [4]: Alice's message. Of Bob [8]: key, Alice's message. Of Alice [8]: goal, key.

    Reward, with e(c) the squared error of a message as a guess of the goal, and e = 0 for one of zeros only:
    Eve -e(c_Eve), Bob and Alice e(c_Eve) - e(c_Bob). Same in both rules.
    """

    @property
    def agents(self) -> tuple[str, ...]:
        return ("eve_0", "bob_0", "alice_0")

    @property
    def teams(self) -> tuple[str, ...]:
        return ("adversaries", "agents", "agents")

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return (self.dim_c, 2 * self.dim_c, 2 * self.dim_c)

    @property
    def dim_c(self) -> int:
        return 4

    @property
    def num_goals(self) -> int:
        return NUM_CODES

    @property
    def num_keys(self) -> int:
        return NUM_CODES

    @property
    def world(self) -> World:
        return World.uniform(3, NUM_CODES, 0.05, 0.05, movable=False)

    def observe(self, state: State) -> tuple[chex.Array, ...]:
        assert state.comm is not None and state.goal is not None and state.key is not None
        goal, key = (one_hot(index, self.dim_c, state.pos.dtype) for index in (state.goal, state.key))
        said = state.comm[ALICE]
        return said, jnp.concatenate([key, said]), jnp.concatenate([goal, key])

    def reward(self, state: State) -> chex.Array:
        assert state.comm is not None and state.goal is not None
        guess = state.comm[:ALICE]
        square = jnp.sum((guess - one_hot(state.goal, self.dim_c, guess.dtype)) ** 2, axis=1)
        error = jnp.where(jnp.any(guess != 0, axis=1), square, 0)
        team = error[EVE] - error[BOB]
        return jnp.stack([-error[EVE], team, team])
