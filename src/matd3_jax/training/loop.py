"""The loop: rollout, replay and updates of many seeds inside one `lax.scan`, the seeds sharded over devices."""

import math
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from matd3_jax.core import minibatch, n_step, q_bias, replay, rollout, running_statistics, update
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import HyperParams
from matd3_jax.core.q_bias import Pairs, Reservoir, Values
from matd3_jax.core.rollout import EnvState, Episodes, Evaluation, PolicyParams
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.core.update import GroupState, UpdateMetrics
from matd3_jax.envs.environment import Environment
from matd3_jax.training.schedule import Schedule

APART_SEEDS, APART_BYTES = 4, 4 * 2**20
"""Up to so many seeds of a device, whose networks and moments take more bytes each, stand apart (`seeds_apart`)."""


class TrainState(NamedTuple):
    """Everything that training carries; leading axis [seeds] but for `rollouts`."""

    groups: tuple[GroupState, ...]
    env: EnvState
    replay: chex.Array
    """[seeds, capacity, row_size]"""
    key: chex.PRNGKey
    rollouts: chex.Array
    """int32 scalar: rollouts done, warm-up included. Steps, updates and the replay's cursor follow from it."""
    statistics: Statistics | None = None
    """Of the observations collected; None where they are not normalized."""
    reservoir: Reservoir | None = None
    """What the critics are judged on (see `q_bias`); None where they are not. `since` has no axis [seeds]."""


class Metrics(NamedTuple):
    """Of one interval: leading axes [seeds, iterations]."""

    episodes: Episodes
    """Sums over the episodes that ended in the iteration."""
    update: UpdateMetrics
    """Means over the updates of the iteration (actor_loss over those that moved the actor)."""


def idle_devices(devices: int, seeds: int, batch_size: int) -> int:
    """How many devices each seed can have where there are fewer seeds than devices: two, if there are two for it and
    they divide the minibatch, else one. More than two were not measured, and each has the seed's whole replay."""
    return 2 if devices >= 2 * seeds and batch_size % 2 == 0 else 1


class TrainLoop:
    """Programs that start and advance the training of `num_seeds` seeds.

    Args:
        layout: agents and algorithms of `env`.
        hyper: for each team its `HyperParams`, every leaf a number or an array [seeds].
        devices: where the seeds are spread out; default all devices.
        devices_per_seed: how many of the devices share the work of one seed, each with an equal part of every
            minibatch (the networks are the same on all, and so is the replay). Default on CPU:
            `idle_devices`; elsewhere 1.
        piece: how many of a device's seeds are updated together; default 1 on CPU (a seed's batch stays in cache) and
            all of them elsewhere.
        normalize_observations: networks see observations in units of their running mean and standard deviation; the
            replay keeps them as they are.
        least_deviation: of what observations are normalized by.
        q_bias_pairs: states and actions that each seed keeps for `measure_q_bias`; 0: none, and no trace of it in the
            programs.
        unroll: how many iterations, and updates after a rollout with many, one pass of their compiled loop holds;
            longer passes are more to compile and fewer launches of an accelerator. The numbers stay the same.
        unroll_steps: the same of the env steps of a rollout.
    """

    def __init__(
        self,
        env: Environment,
        layout: JointLayout,
        schedule: Schedule,
        hyper: dict[str, HyperParams],
        num_seeds: int,
        devices: Sequence[jax.Device] | None = None,
        piece: int | None = None,
        normalize_observations: bool = False,
        least_deviation: float = 0.0,
        q_bias_pairs: int = 0,
        unroll: int = 1,
        unroll_steps: int = 1,
        devices_per_seed: int | None = None,
    ):
        self.env, self.layout, self.schedule, self.num_seeds = env, layout, schedule, num_seeds
        self.unroll, self.unroll_steps = unroll, unroll_steps
        self.normalize_observations, self.q_bias_pairs = normalize_observations, q_bias_pairs
        self.least_deviation = least_deviation
        updates = schedule.updates_per_collect
        for group in layout.groups:
            delay = group.algorithm.policy_delay
            if updates % delay and delay % updates:
                raise ValueError(f"updates_per_collect={updates} and policy_delay={delay}: one must divide the other")
        devices = list(jax.devices() if devices is None else devices)
        self.on_cpu = devices[0].platform == "cpu"
        if devices_per_seed is None:
            devices_per_seed = idle_devices(len(devices), num_seeds, schedule.batch_size) if self.on_cpu else 1
        if schedule.batch_size % devices_per_seed or devices_per_seed > len(devices):
            raise ValueError(f"{devices_per_seed} of {len(devices)} devices cannot share {schedule.batch_size} rows")
        self.devices_per_seed = devices_per_seed
        places = min(len(devices) // devices_per_seed, num_seeds)
        grid = np.array(devices[: places * devices_per_seed]).reshape(places, devices_per_seed)
        self.mesh = Mesh(grid, ("seeds", "minibatch"))
        self.local_seeds = math.ceil(num_seeds / places)
        """Seeds on each device."""
        self.rows = self.local_seeds * places
        """Seeds actually run: `num_seeds` filled up to a multiple of the mesh with copies of the last one."""
        self.piece = piece or (1 if self.on_cpu else self.local_seeds)
        per_group = [hyper[layout.teams[group.members[0]]] for group in layout.groups]
        spread = [
            jax.tree.map(lambda h: jnp.broadcast_to(jnp.asarray(h, jnp.float32), num_seeds), h) for h in per_group
        ]
        self.hyper = tuple(jax.tree.map(self.fill, spread))

    @cached_property
    def seeds_apart(self) -> bool:
        """Whether a program holds the networks of each seed as arrays of their own, its updates one seed after another
        without a loop. A loop over seeds copies each seed's networks out of the stack and back: at 400-300 units that
        took as long as the updates themselves. More seeds would take long to compile."""
        groups = jax.eval_shape(lambda key: update.init(self.layout, key), jax.random.key(0))
        size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(groups))
        few = 1 < self.local_seeds <= APART_SEEDS and self.piece == 1
        return self.on_cpu and few and size > APART_BYTES

    # ---- the schedule in numbers -------------------------------------------------------------------------------------

    @cached_property
    def period(self) -> int:
        """Updates after which every group's policy delay has come round."""
        return math.lcm(*(group.algorithm.policy_delay for group in self.layout.groups))

    @cached_property
    def rollouts_per_iteration(self) -> int:
        return math.lcm(self.period, self.schedule.updates_per_collect) // self.schedule.updates_per_collect

    @property
    def iteration_steps(self) -> int:
        """Env steps of one iteration, each seed."""
        return self.rollouts_per_iteration * self.schedule.rollout_steps

    @property
    def warmup_steps(self) -> int:
        return self.schedule.warmup_rollouts * self.schedule.rollout_steps

    def env_steps(self, rollouts: int) -> int:
        """Env steps a seed after `rollouts` rollouts."""
        return rollouts * self.schedule.rollout_steps

    def updates(self, rollouts: int) -> int:
        """Updates a seed after `rollouts` rollouts."""
        return max(0, rollouts - self.schedule.warmup_rollouts) * self.schedule.updates_per_collect

    @property
    def replay_bytes(self) -> int:
        """Memory of the replay of all seeds, on all devices that have it."""
        return 4 * self.devices_per_seed * self.rows * self.schedule.replay_capacity * self.layout.row_size

    def filled_rows(self, rollouts: int) -> int:
        """Transitions in each seed's replay after `rollouts` rollouts."""
        return int(replay.filled(self.schedule.replay_capacity, self.schedule.rollout_steps, rollouts))

    # ---- seeds over devices ------------------------------------------------------------------------------------------

    def fill(self, leaf: chex.Array) -> chex.Array:
        """A leaf [num_seeds, ...] filled up to the seeds actually run, with copies of the last."""
        extra = self.rows - leaf.shape[0]
        return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], extra, axis=0)]) if extra else leaf

    def device_seeds(self) -> list[tuple[jax.Device, list[int]]]:
        """Each device with the numbers of the seeds it runs (copies bear the last seed's number)."""
        numbers = [min(seed, self.num_seeds - 1) for seed in range(self.rows)]
        shares = [numbers[i : i + self.local_seeds] for i in range(0, self.rows, self.local_seeds)]
        return [(d, share) for row, share in zip(self.mesh.devices, shares, strict=True) for d in row]

    @property
    def shardings(self) -> TrainState:
        """Sharding of each field of the state (a prefix tree)."""
        seeds = NamedSharding(self.mesh, P("seeds"))
        return self._fields(seeds, NamedSharding(self.mesh, P()))

    def _sharded(self, f: Callable, in_specs, out_specs) -> Callable:
        return jax.shard_map(f, mesh=self.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)

    # ---- programs ----------------------------------------------------------------------------------------------------

    def init(self, keys: chex.PRNGKey) -> TrainState:
        """The state of fresh runs, one for each of `keys` [num_seeds]. The replay is allocated here."""
        # Compiler options are for whole programs, not for what is traced into another one.
        init = self._init if isinstance(keys, jax.core.Tracer) else self._compiled_init
        state = init(self.fill(keys))
        capacity = self.schedule.replay_capacity
        allocate = partial(replay.allocate, self.rows, capacity, self.layout.row_size)
        return state._replace(replay=jax.jit(allocate, out_shardings=self.shardings.replay)())

    def abstract_state(self) -> TrainState:
        """Shapes and types of the state, with an empty replay."""
        keys = jax.eval_shape(jax.vmap(jax.random.key), jax.ShapeDtypeStruct((self.rows,), jnp.int32))
        return jax.eval_shape(self._init, keys)

    @cached_property
    def _init(self) -> Callable:
        def one(key):
            network_key, env_key, key = jax.random.split(key, 3)
            env = rollout.start(self.env, env_key, self.schedule.num_envs, rollout.ranged(self.layout))
            return update.init(self.layout, network_key), env, key

        def init(keys):
            groups, env, keys = jax.vmap(one)(keys)
            state = TrainState(groups, env, jnp.zeros((keys.shape[0], 0, 0)), keys, jnp.int32(0))
            if self.q_bias_pairs:
                pairs = jax.vmap(lambda s: q_bias.allocate(s, self.q_bias_pairs, self.layout))(env.state)
                state = state._replace(reservoir=Reservoir(pairs, jnp.int32(0)))
            if not self.normalize_observations:
                return state
            fresh = running_statistics.initial(self.layout.observation_size)
            spread = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (keys.shape[0], *leaf.shape)), fresh)
            return state._replace(statistics=spread)

        return self._sharded(init, P("seeds"), self._specs)

    @cached_property
    def _compiled_init(self) -> Callable:
        # Run once, and a tenth of the time to compile; the numbers are the same to the bit.
        quick = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
        return jax.jit(self._init, compiler_options=quick if self.on_cpu else None)

    @property
    def _specs(self) -> TrainState:
        return self._fields(P("seeds"), P())

    def _fields(self, seeds: Any, everywhere: Any) -> TrainState:
        """A prefix tree of the state: what stands for leaves with and without the axis [seeds]."""
        statistics = seeds if self.normalize_observations else None
        reservoir = Reservoir(seeds, everywhere) if self.q_bias_pairs else None
        return TrainState(seeds, seeds, seeds, seeds, everywhere, statistics, reservoir)

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
            actors = tuple(_stack(one) for one in each)
        else:
            averages = [group.actor_average if average else None for group in state.groups]
            actors = tuple(
                group.actor if mean is None else mean for group, mean in zip(state.groups, averages, strict=True)
            )
        return PolicyParams(actors, self.hyper if hyper is None else hyper, self.scale(state))

    def scale(self, state: TrainState) -> Statistics | None:
        """What observations are normalized by: running statistics, with the least deviation that is set."""
        if state.statistics is None or not self.least_deviation:
            return state.statistics
        return running_statistics.floored(state.statistics, self.least_deviation)

    def rollout(self, state: TrainState, hyper, random: bool = False) -> tuple[TrainState, Episodes]:
        """One collect of all local seeds."""

        def one(policy, env, key):
            length, kept = self.schedule.rollout_length, self.q_bias_pairs > 0
            return rollout.collect(
                self.env,
                self.layout,
                policy,
                env,
                key,
                length,
                random=random,
                keep_states=kept,
                unroll=self.unroll_steps,
            )

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
            merge = jax.vmap(running_statistics.merge, in_axes=(0, 0, None))
            state = state._replace(statistics=merge(state.statistics, x, state.rollouts))
        rows = replay.write(state.replay, rows, state.rollouts)
        state = state._replace(env=env, replay=rows, key=keys[:, 1], rollouts=state.rollouts + 1)
        return state, episodes

    @cached_property
    def warm_up(self) -> "Program":
        """Play `warmup_rollouts` rollouts without learning: (state, episodes [seeds, rollouts])."""
        random = self.schedule.warmup == "random"
        return self.program(partial(self.rollout, random=random), self.schedule.warmup_rollouts)

    def learn(self, state: TrainState, hyper, first: int) -> tuple[TrainState, UpdateMetrics]:
        """The updates after one rollout, piece after piece of the local seeds; `first`: number of the first of them."""
        schedule, groups = self.schedule, self.layout.groups
        size = replay.filled(schedule.replay_capacity, schedule.rollout_steps, state.rollouts)
        batches = 1 if schedule.shared_minibatch else self.layout.num_agents
        unrolled = math.gcd(self.period, schedule.updates_per_collect)
        axis = "minibatch" if self.devices_per_seed > 1 else None

        def stretch(seed, hyper, carry, keys):
            states, metrics = carry, []
            for u in range(unrolled):
                index_key, update_key = jax.random.split(keys[u])
                indices = replay.sample_indices(index_key, size, (batches, schedule.batch_size))
                rows = self.minibatches(state, hyper, seed, minibatch.own_part(indices, axis, dimension=-1))
                move = [(first + u + 1) % group.algorithm.policy_delay == 0 for group in groups]
                states, m = update.update(
                    self.layout, states, hyper, rows, update_key, move, schedule.sequential, self.on_cpu, axis
                )
                metrics.append(m)
            return states, jax.tree.map(lambda *m: jnp.stack(m), *metrics)

        def one(args):
            seed, states, key, hyper = args
            keys = jax.random.split(key, schedule.updates_per_collect).reshape(-1, unrolled)
            if keys.shape[0] == 1:
                states, metrics = stretch(seed, hyper, states, keys[0])
            else:
                states, metrics = jax.lax.scan(partial(stretch, seed, hyper), states, keys, unroll=self.unroll)
            return states, jax.tree.map(lambda m: m.reshape(-1, m.shape[-1]), metrics)

        keys = jax.vmap(partial(jax.random.split, num=2))(state.key)
        seeds = jnp.arange(keys.shape[0])
        if isinstance(state.groups, list):
            rest = _unstack((seeds, keys[:, 0], hyper), len(state.groups))
            found = [
                one((seed, networks, key, own)) for networks, (seed, key, own) in zip(state.groups, rest, strict=True)
            ]
            states, metrics = [networks for networks, _ in found], _stack([m for _, m in found])
        else:
            states, metrics = jax.lax.map(one, (seeds, state.groups, keys[:, 0], hyper), batch_size=self.piece)
        # The next rollout writes where these updates read. Where the actor is delayed nothing else tells XLA to do one
        # after the other, and it would copy the whole replay: so let the count of rollouts, hence the place of the next
        # write, hang on the updates. A mean squared error is never negative; XLA does not know.
        wait = jnp.any(metrics.critic_loss < 0).astype(jnp.int32)
        return state._replace(groups=states, key=keys[:, 1], rollouts=state.rollouts + wait), metrics

    def minibatches(
        self, state: TrainState, hyper: Sequence[HyperParams], seed: chex.Array | int, indices: chex.Array
    ) -> chex.Array:
        """What updates take: the rows [*indices.shape, row_size] of a local seed and its `hyper`, rewards of n_step
        steps in them, observations normalized."""
        schedule, layout = self.schedule, self.layout
        if layout.n_step == 1:
            rows = replay.gather(state.replay, seed, indices)
        else:
            written = replay.Written(schedule.replay_capacity, schedule.rollout_steps, state.rollouts)
            gamma = jnp.stack([jnp.asarray(hyper[layout.place(i)[0]].gamma) for i in range(layout.num_agents)])
            rows = n_step.draw(layout, state.replay, seed, indices, written, schedule.num_envs, gamma)
        scale = self.scale(state)
        if scale is None:
            return rows
        return running_statistics.normalize_rows(self.layout, jax.tree.map(lambda s: s[seed], scale), rows)

    def iteration(self, state: TrainState, hyper) -> tuple[TrainState, Metrics]:
        episodes, metrics = [], []
        for c in range(self.rollouts_per_iteration):
            state, e = self.rollout(state, hyper)
            state, m = self.learn(state, hyper, first=c * self.schedule.updates_per_collect)
            episodes.append(e)
            metrics.append(m)
        total = jax.tree.map(lambda *e: sum(e), *episodes)
        mean = jax.tree.map(lambda *m: jnp.nanmean(jnp.concatenate(m, axis=1), axis=1), *metrics)
        return state, Metrics(total, mean)

    def interval(self, iterations: int) -> "Program":
        """The program of `iterations` iterations: (state, metrics [seeds, iterations]). The state given in is
        donated."""
        return self.program(self.iteration, iterations)

    def program(self, iteration: Callable, iterations: int) -> "Program":
        """`iteration`(state, hyper) -> (state, output) of the local seeds, repeated `iterations` times in one
        `lax.scan`."""

        def repeat(state, hyper):
            if self.seeds_apart:
                state = state._replace(groups=_unstack(state.groups, state.key.shape[0]))
            state, outputs = jax.lax.scan(
                lambda s, _: iteration(s, hyper), state, length=iterations, unroll=self.unroll
            )
            if self.seeds_apart:
                state = state._replace(groups=_stack(state.groups))
            return state, jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), outputs)

        specs = (self._specs, P("seeds"))
        return Program(jax.jit(self._sharded(repeat, specs, specs), donate_argnums=0), self.hyper, iterations)

    def evaluate(self, state: TrainState, keys: chex.PRNGKey, episodes: int, deterministic: bool) -> Evaluation:
        """`rollout.evaluate` of each seed, leading axis [num_seeds]; one program for each kind and number of episodes.
        Deterministic evaluations play the averaged actors, where there are any.

        Args:
            keys: [num_seeds].
        """
        found = self._evaluate(self.policy(state, average=deterministic), self.fill(keys), episodes, deterministic)
        return jax.tree.map(lambda leaf: leaf[: self.num_seeds], found)

    @cached_property
    def _evaluate(self) -> Callable:
        def evaluate(policy, keys, episodes, deterministic):
            def one(policy, key):
                return rollout.evaluate(self.env, self.layout, policy, key, episodes, deterministic)

            return self._sharded(jax.vmap(one), P("seeds"), P("seeds"))(policy, keys)

        return jax.jit(evaluate, static_argnums=(2, 3))

    def measure_q_bias(self, state: TrainState, steps: int) -> Values:
        """`q_bias.measure` of each seed's reservoir with rollouts of `steps` env steps, leading axis [num_seeds]."""
        assert state.reservoir is not None
        critics = tuple(group.critic for group in state.groups)
        found = self._measure_q_bias(self.policy(state), critics, state.reservoir.pairs, state.key, steps)
        return jax.tree.map(lambda leaf: leaf[: self.num_seeds], found)

    @cached_property
    def _measure_q_bias(self) -> Callable:
        def measure(policy, critics, pairs, keys, steps):
            def one(policy, critics, pairs, key):
                apart = jax.random.fold_in(key, rollout.APART)
                return q_bias.measure(self.env, self.layout, policy, critics, pairs, apart, steps)

            return self._sharded(jax.vmap(one), P("seeds"), P("seeds"))(policy, critics, pairs, keys)

        return jax.jit(measure, static_argnums=4)

    def restart_reservoir(self, state: TrainState) -> TrainState:
        """Forget what the reservoir holds: after an evaluation."""
        assert state.reservoir is not None
        since = jax.device_put(np.int32(state.rollouts), self.shardings.reservoir.since)  # type: ignore[union-attr]
        return state._replace(reservoir=state.reservoir._replace(since=since))


def _stack(trees: Sequence[Any]) -> Any:
    """Leaves with a leading axis [trees]."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def _unstack(tree: Any, count: int) -> list[Any]:
    """The inverse of `_stack`."""
    return [jax.tree.map(lambda leaf, k=k: leaf[k], tree) for k in range(count)]


class Program(NamedTuple):
    """A compiled stretch of training: call it with a state, which it takes over."""

    jitted: Any
    hyper: tuple[HyperParams, ...]
    iterations: int

    def __call__(self, state: TrainState) -> tuple[TrainState, Any]:
        return self.jitted(state, self.hyper)
