"""Play one episode of one seed and keep what happened: for pictures, and for a closer look from Python."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.core import acting
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.state import TrainState


class Episode(NamedTuple):
    """An episode, or its beginning: what `play` gives has every frame, from the start to the last env step."""

    step: np.ndarray
    """[frames] env steps so far."""
    states: Any
    """States of the environment, or what `keep` made of them; leading axis [frames]."""
    returns: dict[str, np.ndarray]
    """Of each team [frames]: undiscounted return so far (agents weighted by `Environment.return_weights`)."""
    terminated: bool
    """The task itself ended with the last step."""
    truncated: bool
    """The time limit cut it there."""

    @property
    def length(self) -> int:
        """Env steps."""
        return int(self.step[-1])

    @property
    def end(self) -> str:
        """Why the last step is the last."""
        return "terminated" if self.terminated else "truncated" if self.truncated else "stopped by max_steps"

    @property
    def result(self) -> str:
        """The returns in words."""
        return self._words(-1)

    def at(self, every: int) -> "Episode":
        """Every n-th frame, and the last."""
        index = np.append(np.arange(0, len(self.step) - 1, every), len(self.step) - 1)
        return self._replace(
            step=self.step[index],
            states=jax.tree.map(lambda leaf: leaf[index], self.states),
            returns={team: values[index] for team, values in self.returns.items()},
        )

    def captions(self) -> list[str]:
        """For each frame a line with the env step and the returns so far."""
        return [f"step {step}   {self._words(frame)}" for frame, step in enumerate(self.step)]

    def _words(self, frame: int) -> str:
        # The sum turns -0.0 into 0.0.
        values = {team: f"{round(float(values[frame]), 1) + 0.0:.1f}" for team, values in self.returns.items()}
        if len(values) == 1:
            return f"return {next(iter(values.values()))}"
        return "return: " + ", ".join(f"{team} {value}" for team, value in values.items())


def play(
    training: TrainingSession,
    state: TrainState,
    seed: int = 0,
    number: int = 0,
    deterministic: bool = True,
    max_steps: int | None = None,
    keep: Callable[[Any], Any] = lambda state: state,
) -> Episode:
    """Play an episode with the policies of one seed; see `Player`.

    Args:
        state: what was trained, leading axis [seeds].
        seed: index of the seed in the run, from 0.
    """
    return Player(training, number, deterministic, max_steps, keep).play(state, seed)


class Player:
    """Plays the same episode with policies as they are at different times; compiled once.

    Deterministic, it is the episode `number` of those that `TrainingSession.evaluate` (and the command `evaluate`)
    plays with its default seed.

    Args:
        deterministic: no noise at all; otherwise the policies act as they do in training.
        max_steps: env steps after which to stop.
        keep: what to keep of a state of the environment; by default all of it.
    """

    def __init__(
        self,
        training: TrainingSession,
        number: int = 0,
        deterministic: bool = True,
        max_steps: int | None = None,
        keep: Callable[[Any], Any] = lambda state: state,
    ):
        self.training, self.deterministic = training, deterministic
        self.steps = training.env.episode_length if max_steps is None else min(max_steps, training.env.episode_length)
        self._run = jax.jit(_episode(training, number, deterministic, self.steps, keep))

    def play(self, state: TrainState, seed: int = 0) -> Episode:
        """Play it with the policies of the seed with this index. state: leading axis [seeds]."""
        training, layout = self.training, self.training.layout
        policies = training.trainer.policy(state, average=self.deterministic)
        # Through the host: the seeds may lie on different devices.
        policy = jax.device_get(jax.tree.map(lambda leaf: leaf[seed], policies))
        # The key of `TrainingSession.evaluate` with its default seed.
        key = jax.random.fold_in(jax.random.key(0), 2**31 - 1)
        states, reward, terminated, truncated = self._run(policy, key)
        ended = np.flatnonzero(np.asarray(terminated | truncated))
        length = int(ended[0]) + 1 if len(ended) else self.steps
        so_far = np.cumsum(np.asarray(reward, np.float64)[:length], axis=0)
        so_far = np.concatenate([np.zeros((1, layout.num_agents)), so_far])
        return Episode(
            step=np.arange(length + 1),
            states=jax.tree.map(lambda leaf: leaf[: length + 1], states),
            returns={team: so_far @ training.team_weights(team) for team in dict.fromkeys(layout.teams)},
            terminated=bool(terminated[length - 1]),
            truncated=bool(truncated[length - 1]),
        )


def _episode(training: TrainingSession, number: int, deterministic: bool, steps: int, keep: Callable) -> Callable:
    """(policy, key) -> (states [frames], rewards, terminated, truncated), each but the first [env steps]."""
    env, layout = training.env, training.layout

    def run(policy, key):
        state_key, step_key = jax.random.split(key)
        first, observation = env.reset(jax.random.split(state_key, number + 1)[number])

        def step(carry, key):
            state, observation, recurrent = carry
            act_key, env_key = jax.random.split(key)
            seen, noise = [o[None] for o in observation], None if deterministic else act_key
            chosen, recurrent = acting.decide(layout, policy, seen, noise, recurrent)
            actions = tuple(a[0] for a in chosen)
            after = env.step(jax.random.split(env_key, number + 1)[number], state, actions)
            kept = (keep(after.state), after.reward, after.terminated, after.truncated)
            return (after.state, after.observation, recurrent), kept

        keys = jax.random.split(step_key, env.episode_length)[:steps]
        _, (later, *rest) = jax.lax.scan(step, (first, observation, acting.fresh_state(layout, 1)), keys)
        states = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), keep(first), later)
        return states, *rest

    return run
