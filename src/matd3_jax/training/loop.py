"""The loop: rollout, replay and updates of many seeds inside one `lax.scan`, the seeds sharded over devices."""

import math
from collections.abc import Callable, Sequence
from functools import cached_property, partial

import chex
import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from matd3_jax.core import frozen, minibatch, n_step, q_bias, replay, rollout, running_statistics, update
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.q_bias import Pairs
from matd3_jax.core.rollout import EnvState, Episodes, PolicyParams
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.core.update import UpdateMetrics
from matd3_jax.envs.environment import Environment
from matd3_jax.training import stopping
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
        self.least_deviation = least_deviation
        updates = schedule.updates_per_collect
        for group in layout.learning_groups:
            delay = group.algorithm.policy_delay
            if updates % delay and delay % updates:
                raise ValueError(f"updates_per_collect={updates} and policy_delay={delay}: one must divide the other")
        if env.on_host:  # a seed's copies are stepped once: several devices would each step their own
            devices_per_seed = 1
        sharding = SeedSharding(num_seeds, schedule.batch_size, devices, devices_per_seed, seeds_together)
        self.sharding, self.mesh, self.on_cpu = sharding, sharding.mesh, sharding.on_cpu
        per_group = [hyper[layout.teams[group.members[0]]] for group in layout.groups]
        spread = jax.tree.map(lambda h: jnp.broadcast_to(jnp.asarray(h, jnp.float32), num_seeds), per_group)
        self.hyper = tuple(jax.tree.map(sharding.pad, spread))

    @cached_property
    def seeds_apart(self) -> bool:
        """Whether a program holds the networks of each seed as arrays of their own (`SeedSharding.apart`)."""
        groups = jax.eval_shape(lambda key: update.init(self.layout, key), jax.random.key(0))
        return self.sharding.apart(sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(groups)))

    # ---- the schedule in numbers -------------------------------------------------------------------------------------

    @cached_property
    def period(self) -> int:
        """Updates after which every group's policy delay has come round."""
        return math.lcm(*(group.algorithm.policy_delay for group in self.layout.learning_groups))

    @cached_property
    def rollouts_per_iteration(self) -> int:
        return math.lcm(self.period, self.schedule.updates_per_collect) // self.schedule.updates_per_collect

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
        return jax.tree.map(self.sharding.named, self._specs)

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
            return rollout.start(self.env, apart, self.schedule.num_envs, rollout.ranged(self.layout))

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
        return self.sharding.sharded(begin, P("seeds"), self._specs)

    @cached_property
    def _compiled_init(self) -> Callable:
        # Run once, and a tenth of the time to compile; the numbers are the same to the bit.
        quick = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
        return jax.jit(self._init, compiler_options=quick if self.on_cpu else None)

    @property
    def _specs(self) -> TrainState:
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
        return PolicyParams(actors, self.hyper if hyper is None else hyper, self.scale(state), scales)

    def scale(self, state: TrainState) -> Statistics | None:
        """What observations are normalized by: running statistics, with the least deviation that is set."""
        if state.statistics is None or not self.least_deviation:
            return state.statistics
        return running_statistics.floored(state.statistics, self.least_deviation)

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

    def learn(self, state: TrainState, hyper, first: int) -> tuple[TrainState, UpdateMetrics]:
        """Make the updates after one rollout, `seeds_together` of the local seeds at a time; `first`: number of the
        first of them."""
        schedule, groups = self.schedule, self.layout.groups
        size = replay.filled(schedule.replay_capacity, schedule.rollout_steps, state.rollouts)
        batches = 1 if schedule.shared_minibatch else self.layout.num_agents
        unrolled = math.gcd(self.period, schedule.updates_per_collect)
        axis = self.sharding.minibatch_axis

        def period(seed, hyper, carry, keys):
            states, metrics = carry, []
            for u in range(unrolled):
                index_key, update_key = jax.random.split(keys[u])
                indices = replay.sample_indices(index_key, size, (batches, schedule.batch_size))
                raw = self._drawn(state, hyper, seed, minibatch.own_part(indices, axis, dimension=-1))
                others = frozen.next_actions(self.layout, states, raw)
                rows = self._normalized(state, seed, raw)
                move = [(first + u + 1) % group.algorithm.policy_delay == 0 for group in groups]
                how = (schedule.sequential, self.on_cpu, axis, others)
                states, m = update.update(self.layout, states, hyper, rows, update_key, move, *how)
                metrics.append(m)
            return states, jax.tree.map(lambda *m: jnp.stack(m), *metrics)

        def one(args):
            seed, states, key, hyper, stopped = args
            if stopped is None or axis is not None:  # a branch that some devices alone take must not talk to others
                return learned(seed, states, key, hyper)
            nothing = jax.tree.map(
                lambda leaf: jnp.full(leaf.shape, jnp.nan), jax.eval_shape(learned, seed, states, key, hyper)[1]
            )
            return jax.lax.cond(stopped, lambda: (states, nothing), lambda: learned(seed, states, key, hyper))

        def learned(seed, states, key, hyper):
            keys = jax.random.split(key, schedule.updates_per_collect).reshape(-1, unrolled)
            if keys.shape[0] == 1:
                states, metrics = period(seed, hyper, states, keys[0])
            else:
                states, metrics = jax.lax.scan(partial(period, seed, hyper), states, keys, unroll=self.unroll)
            return states, jax.tree.map(lambda m: m.reshape(-1, m.shape[-1]), metrics)

        keys = jax.vmap(partial(jax.random.split, num=2))(state.key)
        seeds = jnp.arange(keys.shape[0])
        if isinstance(state.groups, list):
            rest = unstack((seeds, keys[:, 0], hyper, state.stopped), len(state.groups))
            found = [one((seed, g, *own)) for g, (seed, *own) in zip(state.groups, rest, strict=True)]
            states, metrics = [networks for networks, _ in found], stack([m for _, m in found])
        else:
            together = self.sharding.seeds_together
            per_seed = seeds, state.groups, keys[:, 0], hyper, state.stopped
            states, metrics = jax.lax.map(one, per_seed, batch_size=together)
        # The next rollout writes where these updates read. Where the actor is delayed nothing else makes XLA do one
        # after the other, and it would copy the whole replay: so let the count of rollouts, hence the next write's
        # offset, depend on the updates. A mean squared error is never negative; XLA does not know.
        wait = jnp.any(metrics.critic_loss < 0).astype(jnp.int32)
        return state._replace(groups=states, key=keys[:, 1], rollouts=state.rollouts + wait), metrics

    def minibatches(
        self, state: TrainState, hyper: Sequence[HyperParams], seed: chex.Array | int, indices: chex.Array
    ) -> chex.Array:
        """What updates take: the rows [*indices.shape, row_size] of a local seed and its `hyper`, rewards of n_step
        steps in them, observations normalized."""
        return self._normalized(state, seed, self._drawn(state, hyper, seed, indices))

    def _drawn(
        self, state: TrainState, hyper: Sequence[HyperParams], seed: chex.Array | int, indices: chex.Array
    ) -> chex.Array:
        """`minibatches` before their observations are normalized."""
        schedule, layout = self.schedule, self.layout
        if layout.n_step == 1:
            return replay.gather(state.replay, seed, indices)
        written = replay.Written(schedule.replay_capacity, schedule.rollout_steps, state.rollouts)
        gamma = jnp.stack([jnp.asarray(hyper[layout.place(i)[0]].gamma) for i in range(layout.num_agents)])
        return n_step.draw(layout, state.replay, seed, indices, written, schedule.num_envs, gamma)

    def _normalized(self, state: TrainState, seed: chex.Array | int, rows: chex.Array) -> chex.Array:
        """Replay rows [..., row_size] of a local seed with x and x' as networks see them."""
        scale = self.scale(state)
        if scale is None:
            return rows
        return running_statistics.normalize_rows(self.layout, jax.tree.map(lambda s: s[seed], scale), rows)

    def iteration(self, state: TrainState, hyper) -> tuple[TrainState, Metrics]:
        episodes, metrics = [], []
        for c in range(self.rollouts_per_iteration):
            before = state
            state, e = self.rollout(state, hyper)
            state, m = self.learn(state, hyper, first=c * self.schedule.updates_per_collect)
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

        specs = (self._specs, P("seeds"))
        return Program(jax.jit(self.sharding.sharded(repeat, specs, specs), donate_argnums=0), self.hyper, iterations)
