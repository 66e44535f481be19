"""Runs for test_encounter and test_crossplay: nothing is trained, networks and statistics are random."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax import config, envs
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.evaluation import cross_play
from matd3_jax.training.session import TrainingSession

STEPS, SEED = 5, 11
SMALL = [
    "env=simple_adversary", f"env.episode_length={STEPS}", "batch_size=8", "num_envs=2", "rollout_length=5",
    "learning_starts=20", "replay_capacity=100", "total_steps=100", "algo.hidden=[5]",
]  # fmt: skip
RUNS = {
    # Networks of two sizes; observations normalized; agents joined into one, the adversary by itself; nothing special.
    "mixed": ["algo=matd3", "adversary=maddpg", "adversary.hidden=[4,4]", "seeds=3"],
    "normal": ["algo=iltd3", "normalize_observations=true", "seeds=2", "seed=7"],
    "joint": ["algo=td3", "adversary=iddpg", "normalize_observations=true", "seeds=3"],
    "plain": ["algo=maddpg", "seeds=3", "seed=4"],
}


class Run(NamedTuple):
    training: TrainingSession
    state: object

    def team(self, name):
        base = self.training.env.env if hasattr(self.training.env, "env") else self.training.env
        return cross_play.team_of(self.training, base, self.state, name)


def make(settings, env=None, number=0):
    """A run whose policies (biases too) and statistics are random: of which training they come does not matter."""
    training, rng = TrainingSession(config.load(settings), env), np.random.default_rng(number)
    trainer = training.trainer
    shapes = trainer.abstract_state()
    groups = jax.tree.map(lambda leaf: rng.normal(0, 0.5, leaf.shape).astype(leaf.dtype), shapes.groups)
    statistics = shapes.statistics
    if statistics is not None:
        mean, variance = rng.normal(size=(2, *statistics.mean.shape)).astype(np.float32)
        statistics = Statistics(mean, np.exp(variance))
    return Run(
        training,
        shapes._replace(
            groups=groups,
            env=jax.tree.map(lambda shape: np.zeros(shape.shape, shape.dtype), shapes.env),
            replay=jnp.zeros(
                (trainer.sharding.padded_seeds, trainer.schedule.replay_capacity, training.layout.row_size)
            ),
            key=trainer.sharding.pad(training.keys()),
            rollouts=jnp.int32(2),
            statistics=statistics,
        ),
    )


@functools.cache
def runs():
    """The run of each name."""
    return {name: make([*SMALL, *more], number=k) for k, (name, more) in enumerate(RUNS.items())}


ENV = envs.make("simple_adversary", episode_length=STEPS)
OWN = np.stack([np.arange(3)] * 2, axis=1)


def meet(runs, one, two, pairs, episodes=4, deterministic=True, seed=SEED, env=ENV):
    teams = [runs[one].team("agents"), runs[two].team("adversaries")]
    return cross_play.play(env, teams, np.asarray(pairs), episodes, deterministic, seed)
