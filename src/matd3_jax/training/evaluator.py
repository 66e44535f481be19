"""Programs that judge what the seeds have learned: whole episodes, and the critics' estimates against true values."""

from collections.abc import Callable
from functools import cached_property

import chex
import jax
import numpy as np
from jax.sharding import PartitionSpec as P

from matd3_jax.core import q_bias, rollout
from matd3_jax.core.q_bias import Values
from matd3_jax.core.rollout import Evaluation
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.state import TrainState


class Evaluator:
    """Judges the seeds of a `TrainLoop`, each on the devices that train it."""

    def __init__(self, loop: TrainLoop):
        self.loop = loop

    def evaluate(self, state: TrainState, keys: chex.PRNGKey, episodes: int, deterministic: bool) -> Evaluation:
        """`rollout.evaluate` of each seed, leading axis [num_seeds]; one program for each kind and number of episodes.
        Deterministic evaluations play the averaged actors, where there are any.

        Args:
            keys: [num_seeds].
        """
        found = self._evaluate(
            self.loop.policy(state, average=deterministic), self.loop.sharding.pad(keys), episodes, deterministic
        )
        return jax.tree.map(lambda leaf: leaf[: self.loop.num_seeds], found)

    @cached_property
    def _evaluate(self) -> Callable:
        def evaluate(policy, keys, episodes, deterministic):
            def one(policy, key):
                return rollout.evaluate(self.loop.env, self.loop.layout, policy, key, episodes, deterministic)

            return self.loop.sharding.sharded(jax.vmap(one), P("seeds"), P("seeds"))(policy, keys)

        return jax.jit(evaluate, static_argnums=(2, 3))

    def measure_q_bias(self, state: TrainState, steps: int) -> Values:
        """`q_bias.measure` of each seed's reservoir with rollouts of `steps` env steps, leading axis [num_seeds]."""
        assert state.reservoir is not None
        critics = tuple(group.critic for group in state.groups)
        found = self._measure_q_bias(self.loop.policy(state), critics, state.reservoir.pairs, state.key, steps)
        return jax.tree.map(lambda leaf: leaf[: self.loop.num_seeds], found)

    @cached_property
    def _measure_q_bias(self) -> Callable:
        def measure(policy, critics, pairs, keys, steps):
            def one(policy, critics, pairs, key):
                apart = jax.random.fold_in(key, rollout.APART)
                return q_bias.measure(self.loop.env, self.loop.layout, policy, critics, pairs, apart, steps)

            return self.loop.sharding.sharded(jax.vmap(one), P("seeds"), P("seeds"))(policy, critics, pairs, keys)

        return jax.jit(measure, static_argnums=4)

    def restart_reservoir(self, state: TrainState) -> TrainState:
        """Forget what the reservoir holds: after an evaluation."""
        assert state.reservoir is not None
        since = jax.device_put(np.int32(state.rollouts), self.loop.shardings.reservoir.since)  # type: ignore[union-attr]
        return state._replace(reservoir=state.reservoir._replace(since=since))
