"""The loop: rollout, replay and updates of many seeds inside one `lax.scan`, the seeds sharded over devices."""

import math
from collections.abc import Callable, Sequence
from functools import cached_property, partial

import chex
import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from matd3_jax.core import acting, q_bias, replay, rollout, running_statistics, update
from matd3_jax.core.acting import PolicyParams
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.q_bias import Pairs
from matd3_jax.core.rollout import EnvState, Episodes
from matd3_jax.envs.environment import Environment
from matd3_jax.training import stopping
from matd3_jax.training.learner import Learner
from matd3_jax.training.program import Program
from matd3_jax.training.schedule import Schedule
from matd3_jax.training.sharding import SeedSharding, stack, unstack
from matd3_jax.training.state import Metrics, TrainState, initial, prefix


class TrainLoop:
    """Programs that start and advance the training of `num_seeds` seeds.

    Args:
        layout: agents and algorithms of `env`.
        hyper: for each team its `HyperParams`, every leaf a number or an array [seeds].
        devices, devices_per_seed, seeds_together: of `SeedSharding`.
        normalize_observations: networks see observations in units of their running mean and standard deviation; the
            replay keeps them as they are.
        least_deviation: of what observations are normalized by.
        earlier_statistics: runs may begin with statistics of another run.
        q_bias_pairs: states and actions that each seed keeps for `Evaluator.measure_q_bias`; 0: none, and no trace of
            it in the programs.
        unroll: how many iterations, and updates after a rollout with many, one pass of their compiled loop holds;
            longer passes are more to compile and fewer launches of an accelerator. The numbers stay the same.
        unroll_steps: the same of the env steps of a rollout.
        stop_seeds: a seed that diverges learns no more (see `stopping`).
    """

    def __init__(
        self,
        env: Environment,
        layout: JointLayout,
        schedule: Schedule,
        hyper: dict[str, HyperParams],
        num_seeds: int,
        devices: Sequence[jax.Device] | None = None,
        seeds_together: int | None = None,
        normalize_observations: bool = False,
        least_deviation: float = 0.0,
        q_bias_pairs: int = 0,
        unroll: int = 1,
        unroll_steps: int = 1,
        devices_per_seed: int | None = None,
        earlier_statistics: bool = False,
        stop_seeds: bool = False,
    ):
        self.stop_seeds = stop_seeds
        self.earlier_statistics = earlier_statistics and normalize_observations
        self.env, self.layout, self.schedule, self.num_seeds = env, layout, schedule, num_seeds
        self.unroll, self.unroll_steps = unroll, unroll_steps
        self.normalize_observations, self.q_bias_pairs = normalize_observations, q_bias_pairs
        updates = schedule.updates_per_collect
        for group in layout.learning_groups:
            delay = group.algorithm.policy_delay
            if updates % delay and delay % updates:
                raise ValueError(f"updates_per_collect={updates} and policy_delay={delay}: one must divide the other")
            if (group.shared or group.team_critic) and schedule.sequential or group.shared and schedule.random_order:
                raise ValueError("agents that share a network have no order in which they learn")
        if env.on_host:  # a seed's copies are stepped once: several devices would each step their own
            devices_per_seed = 1
        shared = schedule.batch_size // layout.sequence_length  # devices share whole sequences
        sharding = SeedSharding(num_seeds, shared, devices, devices_per_seed, seeds_together)
        self.sharding, self.mesh, self.on_cpu = sharding, sharding.mesh, sharding.on_cpu
        self.learner = Learner(layout, schedule, sharding, least_deviation, unroll)
        self.hyper = self.per_group(hyper)

    def per_group(self, hyper: dict[str, HyperParams]) -> tuple[HyperParams, ...]:
        """Spread the hyper-parameters of teams, numbers or arrays [num_seeds], over groups: leaves [padded_seeds]."""
        each = [hyper[self.layout.teams[group.members[0]]] for group in self.layout.groups]
        spread = jax.tree.map(lambda h: jnp.broadcast_to(jnp.asarray(h, jnp.float32), self.num_seeds), each)
        return tuple(jax.tree.map(self.sharding.pad, spread))

    @cached_property
    def seeds_apart(self) -> bool:
        """Whether a program holds the networks of each seed as arrays of their own (`SeedSharding.apart`)."""
        groups = jax.eval_shape(lambda key: update.init(self.layout, key), jax.random.key(0))
        return self.sharding.apart(sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(groups)))

    # ---- the schedule in numbers -------------------------------------------------------------------------------------

    @cached_property
    def rollouts_per_iteration(self) -> int:
        return math.lcm(self.learner.period, self.schedule.updates_per_collect) // self.schedule.updates_per_collect

    @property
    def iteration_steps(self) -> int:
        """Env steps of one iteration, each seed."""
        return self.rollouts_per_iteration * self.schedule.rollout_steps

    def env_steps(self, rollouts: int) -> int:
        """Env steps a seed after `rollouts` rollouts."""
        return rollouts * self.schedule.rollout_steps

    def updates(self, rollouts: int) -> int:
        """Updates a seed after `rollouts` rollouts."""
        return max(0, rollouts - self.schedule.warmup_rollouts) * self.schedule.updates_per_collect

    @property
    def replay_bytes(self) -> int:
        """Memory of the replay of all seeds, on all devices that have it."""
        copies = self.sharding.padded_seeds * self.sharding.devices_per_seed
        return 4 * copies * self.schedule.replay_capacity * self.layout.row_size

    @property
    def shardings(self) -> TrainState:
        """Sharding of each field of the state (a prefix tree)."""
        return jax.tree.map(self.sharding.named, self.specs)

    # ---- programs ----------------------------------------------------------------------------------------------------

    def init(self, keys: chex.PRNGKey) -> TrainState:
        """The state of fresh runs, one for each of `keys` [num_seeds]. The replay is allocated here."""
        # Compiler options are for whole programs, not for what is traced into another one.
        init = self._init if isinstance(keys, jax.core.Tracer) else self._compiled_init
        state = init(self.sharding.pad(keys))
        capacity = self.schedule.replay_capacity
        allocate = partial(replay.allocate, self.sharding.padded_seeds, capacity, self.layout.row_size)
        return state._replace(replay=jax.jit(allocate, out_shardings=self.shardings.replay)())

    @cached_property
    def fresh_environments(self) -> Callable[[TrainState], EnvState]:
        """Make environments at the start of new episodes for each seed of a state, whose keys give them."""

        def one(key):
            apart = jax.random.fold_in(key, rollout.APART)
            ranged = acting.ranged(self.layout)
            return rollout.start(self.env, apart, self.schedule.num_envs, ranged, self.layout.state_size)

        start = jax.jit(self.sharding.sharded(jax.vmap(one), P("seeds"), P("seeds")))
        return lambda state: start(state.key)

    def abstract_state(self) -> TrainState:
        """Shapes and types of the state, with an empty replay."""
        return self._abstract_state

    @cached_property
    def _abstract_state(self) -> TrainState:
        keys = jax.eval_shape(jax.vmap(jax.random.key), jax.ShapeDtypeStruct((self.sharding.padded_seeds,), jnp.int32))
        return jax.eval_shape(self._init, keys)

    @cached_property
    def _init(self) -> Callable:
        settings = self.env, self.layout, self.schedule.num_envs, self.normalize_observations
        begin = partial(initial, *settings, self.q_bias_pairs, self.earlier_statistics, self.stop_seeds)
        return self.sharding.sharded(begin, P("seeds"), self.specs)

    @cached_property
    def _compiled_init(self) -> Callable:
        # Run once, and a tenth of the time to compile; the numbers are the same to the bit.
        quick = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
        return jax.jit(self._init, compiler_options=quick if self.on_cpu else None)

    @property
    def specs(self) -> TrainState:
        """Along which axis of the mesh each field of the state is divided (a prefix tree)."""
        there = self.normalize_observations, self.q_bias_pairs > 0, self.earlier_statistics, self.stop_seeds
        return prefix(P("seeds"), P(), *there)

    def policy(
        self, state: TrainState, hyper: tuple[HyperParams, ...] | None = None, average: bool = False
    ) -> PolicyParams:
        """How each seed acts, leading axis [seeds].

        Args:
            hyper: of the seeds in `state`; default: of all.
            average: with the averaged actors, where there are any.
        """
        if isinstance(state.groups, list):  # inside a program whose seeds are apart
            each = zip(*([group.actor for group in groups] for groups in state.groups), strict=True)
            actors = tuple(stack(one) for one in each)
            each_scale = zip(*([group.scale for group in groups] for groups in state.groups), strict=True)
            scales = tuple(stack(one) for one in each_scale)
        else:
            averaged = [average and group.actor_average is not None for group in state.groups]
            actors = tuple(g.actor_average if a else g.actor for g, a in zip(state.groups, averaged, strict=True))
            scales = tuple(g.scale for g in state.groups)
        scales = scales if any(group.frozen for group in self.layout.groups) else ()
        return PolicyParams(actors, self.hyper if hyper is None else hyper, self.learner.scale(state), scales)

    def rollout(self, state: TrainState, hyper, random: bool = False) -> tuple[TrainState, Episodes]:
        """Play one rollout of all local seeds."""

        def one(policy, env, key):
            how = {"random": random, "keep_states": self.q_bias_pairs > 0, "unroll": self.unroll_steps}
            return rollout.collect(self.env, self.layout, policy, env, key, self.schedule.rollout_length, **how)

        keys = jax.vmap(partial(jax.random.split, num=2))(state.key)
        env, rows, episodes, states = jax.vmap(one)(self.policy(state, hyper), state.env, keys[:, 0])
        if state.reservoir is not None:
            # A key apart from those that `rollout.collect` splits off the same one: training stays as it is without.
            apart = jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys[:, 0], rollout.APART)
            share = 1 / (state.rollouts + 1.0 - state.reservoir.since)
            new = Pairs(states, self.layout.row_parts(rows).inputs)
            pairs = jax.vmap(q_bias.keep, in_axes=(0, 0, None, 0))(state.reservoir.pairs, new, share, apart)
            state = state._replace(reservoir=state.reservoir._replace(pairs=pairs))
        if state.statistics is not None:
            x = self.layout.row_parts(rows).x
            before = state.rollouts if state.earlier is None else state.rollouts + state.earlier
            merge = jax.vmap(running_statistics.merge, in_axes=(0, 0, None if state.earlier is None else 0))
            state = state._replace(statistics=merge(state.statistics, x, before))
        rows = replay.write(state.replay, rows, state.rollouts)
        state = state._replace(env=env, replay=rows, key=keys[:, 1], rollouts=state.rollouts + 1)
        return state, episodes

    @cached_property
    def warm_up(self) -> Program:
        """Play `warmup_rollouts` rollouts without learning: (state, episodes [seeds, rollouts])."""
        random = self.schedule.warmup == "random"
        return self.program(partial(self.rollout, random=random), self.schedule.warmup_rollouts)

    def iteration(self, state: TrainState, hyper) -> tuple[TrainState, Metrics]:
        episodes, metrics = [], []
        for c in range(self.rollouts_per_iteration):
            before = state
            state, e = self.rollout(state, hyper)
            state, m = self.learner.learn(state, hyper, first=c * self.schedule.updates_per_collect)
            if self.stop_seeds:
                learning = stopping.of_agents(m, self.layout.learners)
                state = stopping.stop_diverged(before, state, e, learning)
            episodes.append(e)
            metrics.append(m)
        total = jax.tree.map(lambda *e: sum(e), *episodes)
        mean = jax.tree.map(lambda *m: jnp.nanmean(jnp.concatenate(m, axis=1), axis=1), *metrics)
        return state, Metrics(total, mean)

    def interval(self, iterations: int) -> Program:
        """The program of `iterations` iterations: (state, metrics [seeds, iterations]). The state given in is
        donated."""
        return self.program(self.iteration, iterations)

    def program(self, iteration: Callable, iterations: int) -> Program:
        """`iteration`(state, hyper) -> (state, output) of the local seeds, repeated `iterations` times in one
        `lax.scan`."""

        def repeat(state, hyper):
            if self.seeds_apart:
                state = state._replace(groups=unstack(state.groups, state.key.shape[0]))
            state, outputs = jax.lax.scan(
                lambda s, _: iteration(s, hyper), state, length=iterations, unroll=self.unroll
            )
            if self.seeds_apart:
                state = state._replace(groups=stack(state.groups))
            return state, jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), outputs)

        specs = (self.specs, P("seeds"))
        return Program(jax.jit(self.sharding.sharded(repeat, specs, specs), donate_argnums=0), self.hyper, iterations)
