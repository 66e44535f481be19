"""How play and learning alternate."""

import dataclasses
import math

from matd3_jax.config import Config


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Static.

    A rollout of `num_envs * rollout_length` env steps, then `updates_per_collect` updates; actors and targets move with
    every policy_delay-th update. The unit that the scan repeats (an iteration) is the least number of rollouts whose
    updates hold every algorithm's delay a whole number of times, so that the delay is structure and not a condition.
    """

    num_envs: int = 4
    rollout_length: int = 25
    updates_per_collect: int = 1
    batch_size: int = 1024
    replay_capacity: int = 1_000_000
    """Transitions a seed; a multiple of `rollout_steps`."""
    learning_starts: int = 25_600
    """Transitions in the replay at the first update."""
    warmup: str = "policy"
    """Before that, "policy": the untrained policies act; "random": uniform actions."""
    shared_minibatch: bool = False
    """One minibatch (and one set of target actions) for all agents instead of one each."""
    sequential: bool = False
    """Update the agents one after another (see `update.update`)."""
    random_order: bool = False
    """Move the actors one after another in random order (see `update.update`)."""

    @classmethod
    def of(cls, config: Config) -> "Schedule":
        """That of a run with these settings, with room in the replay for all that they ask for."""
        return cls(
            num_envs=config.num_envs,
            rollout_length=config.rollout_length,
            updates_per_collect=config.updates_per_collect,
            batch_size=config.batch_size,
            replay_capacity=config.replay_capacity,
            learning_starts=config.learning_starts,
            warmup=config.warmup,
            shared_minibatch=config.shared_minibatch,
            sequential=config.update_order == "sequential",
            random_order=config.update_order == "random_sequential",
        )

    @property
    def rollout_steps(self) -> int:
        """Env steps of one rollout."""
        return self.num_envs * self.rollout_length

    @property
    def warmup_rollouts(self) -> int:
        """Rollouts before the loop: the first rollout of the loop then reaches `learning_starts`."""
        return max(0, math.ceil(self.learning_starts / self.rollout_steps) - 1)

    @property
    def warmup_steps(self) -> int:
        """Env steps before the loop."""
        return self.warmup_rollouts * self.rollout_steps

    def filled_rows(self, rollouts: int) -> int:
        """Transitions in each seed's replay after `rollouts` rollouts."""
        return min(rollouts, self.replay_capacity // self.rollout_steps) * self.rollout_steps
