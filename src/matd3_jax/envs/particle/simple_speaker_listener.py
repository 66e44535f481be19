"""simple_speaker_listener (Cooperative Communication): one knows the goal, the other can walk there."""

import dataclasses

import chex
import jax.numpy as jnp

from matd3_jax.envs.environment import check_count
from matd3_jax.envs.particle.task import ParticleTask, Parts
from matd3_jax.envs.particle.world import State, World, choose, one_hot

NUM_LANDMARKS = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimpleSpeakerListener(ParticleTask):
    """An immovable speaker, a silent listener, three landmarks, one of them the goal.

    Observation of the speaker [3]: color of the goal, 0.15 and 0.65 at the goal's index. Of the listener [11]: own
    velocity 2, landmarks relative to oneself 6, the speaker's message 3.

    Reward of both: minus the squared distance of listener and goal; twice that under "orig", which adds both rewards.

    speaking_steps: env steps of an episode in which the speaker can speak, None for all, so that the listener must
    remember. Numbered from 1, env step k ends with the observation that holds the message of its own action. So the
    listener hears zeros at the reset, the message of env step k after each k <= speaking_steps, and zeros from then on;
    the speaker's later actions have no effect. Observations do not say how many env steps have passed.

    Raises OptionError for impossible values.
    """

    speaking_steps: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.speaking_steps is not None:
            check_count("speaking_steps", self.speaking_steps, 1)

    @property
    def agents(self) -> tuple[str, ...]:
        return ("speaker_0", "listener_0")

    @property
    def observation_sizes(self) -> tuple[int, ...]:
        return (3, 2 + 2 * NUM_LANDMARKS + self.dim_c)

    @property
    def dim_c(self) -> int:
        return 3

    @property
    def num_goals(self) -> int:
        return NUM_LANDMARKS

    @property
    def world(self) -> World:
        return dataclasses.replace(World.uniform(2, NUM_LANDMARKS, 0.075, 0.04), movable=(False, True))

    def observe(self, state: State) -> tuple[chex.Array, ...]:
        assert state.comm is not None and state.goal is not None
        color = 0.15 + 0.5 * one_hot(state.goal, NUM_LANDMARKS, state.pos.dtype)
        return color, jnp.concatenate([state.vel[1], (state.landmark - state.pos[1]).reshape(-1), state.comm[0]])

    def _messages(self, state: State, words: Parts) -> chex.Array | None:
        said = super()._messages(state, words)
        if self.speaking_steps is None or said is None:
            return said
        return jnp.where(state.step < self.speaking_steps, said, 0)  # `step`: env steps before this one

    def reward(self, state: State) -> chex.Array:
        assert state.goal is not None
        square = jnp.sum((choose(state.goal, state.landmark) - state.pos[1]) ** 2)
        return jnp.full(2, -2 * square if self.rules == "orig" else -square)
