"""How long a run is going to take, said before it starts: its matrix products, counted, at a rate measured here."""

import functools
import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

from matd3_jax.core import gru, update
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.group import Group
from matd3_jax.envs.environment import Environment
from matd3_jax.training.schedule import Schedule
from matd3_jax.training.session import TrainingSession

REACHED = 0.6
"""Share of the rate of its products that the whole loop reaches (docs/performance.md: 0.54 to 0.72)."""

MJX_STEPS = {"mjx": 1319.0, "mjx_fast": 11001.0}
"""Env steps/s of one core, of the Ant in 16 environments (docs/performance.md, Robots): measuring it here would mean
compiling MJX."""


# ---- counted ---------------------------------------------------------------------------------------------------------


def acting_flops(layout: JointLayout) -> float:
    """Floating point operations of the policies' matrix products in one env step of one seed."""
    return 2.0 * sum(len(group.members) * (_forward(_actor(group)) + _state_products(group)) for group in layout.groups)


def update_flops(layout: JointLayout, schedule: Schedule) -> float:
    """Floating point operations of the matrix products in one update of one seed, all agents, actors counted as often
    as they move."""
    return 2.0 * schedule.batch_size * sum(_group(layout, schedule, group) for group in layout.learning_groups)


def step_flops(layout: JointLayout, schedule: Schedule) -> float:
    """Floating point operations of the matrix products in one env step of one seed once it learns."""
    updates = schedule.updates_per_collect / schedule.rollout_steps
    return acting_flops(layout) + updates * update_flops(layout, schedule)


def _group(layout: JointLayout, schedule: Schedule, group: Group) -> float:
    """Multiplications of an update of a group's agents, for each transition: see `core.losses`. Those of a team's one
    set of critics count to its first group."""
    critics, actor = _member(layout, schedule, group)
    members = len(group.members)
    g = layout.groups.index(group)
    sets = members if not group.team_critic else int(layout.critic_group(g) == g)
    return sets * critics + members * actor


def _member(layout: JointLayout, schedule: Schedule, group: Group) -> tuple[float, float]:
    """(of a set of critics, of an actor)."""
    algorithm, size = group.algorithm, group.action_space.size
    inputs = update.critic_input_size(layout, group)
    actor, critic = _actor(group), (inputs + group.state_size, *group.algorithm.hidden, group.critic.num_outputs)
    # Steps that a state is brought forward for each transition that is learned from.
    steps = (layout.burn_in + layout.sequence_length) / layout.sequence_length
    target_actions = _forward(actor) + steps * _state_products(group)
    if algorithm.central:
        target_actions = sum(
            len(other.members) * (_forward(_actor(other)) + steps * _state_products(other)) for other in layout.groups
        )
        if schedule.shared_minibatch and not schedule.sequential and not group.team_critic:
            target_actions /= len(group.members)
    targets, climbed = algorithm.critics_in_target, algorithm.critics_climbed
    # The targets' values; the critics' own, and their gradients.
    critics = targets * _forward(critic) + algorithm.num_critics * (2 * _forward(critic) + _inputs(critic))
    if group.recurrent:
        states = steps * gru.multiplications(inputs, group.state_size)
        critics += targets * states + algorithm.num_critics * (states + gru.slopes(inputs, group.state_size))
        # Back to the first layer's inputs, of which states are a part.
        critics += algorithm.num_critics * critic[0] * critic[1]
    # Where others' actions are moved: values at the actions as they are, and back to the first layer's inputs.
    slopes = (_forward(critic) + _inputs(critic) + critic[0] * critic[1]) if algorithm.adversarial else 0
    # Through a critic back to the own action: its part of the first layer's inputs, once each way.
    through = _forward(critic) + _inputs(critic) + 2 * size * critic[1]
    actors = 2 * _forward(actor) + _inputs(actor) + climbed * (through + slopes)
    if group.recurrent:
        actors += climbed * states + steps * _state_products(group) + actor[0] * actor[1]
        actors += gru.slopes(group.observation_size + size, group.state_size)
    if algorithm.adversarial and algorithm.critic_head != "categorical":
        actors -= climbed * critic[-2] * critic[-1]  # the slope of a mean needs no outputs
    if schedule.random_order and algorithm.central:  # everybody's actions in x, by the policies of now
        actors += sum(len(other.members) * _forward(_actor(other)) for other in layout.learning_groups)
    judging = target_actions + critics + targets * slopes
    if group.team_critic and not schedule.random_order:  # all actors climb one product of what was replayed
        once = climbed * critic[0] * critic[1]
        judging, actors = judging + once / algorithm.policy_delay, actors - once
    return judging, actors / algorithm.policy_delay


def _actor(group: Group) -> tuple[int, ...]:
    return group.observation_size + group.state_size, *group.algorithm.hidden, group.action_space.size


def _state_products(group: Group) -> float:
    """Multiplications of an actor's state for each step."""
    if not group.recurrent:
        return 0
    return gru.multiplications(group.observation_size + group.action_space.size, group.state_size)


def _forward(sizes: Sequence[int]) -> float:
    """Multiplications of a perceptron with layers of these sizes, for each row; its kernels' gradients take as many."""
    return sum(i * o for i, o in pairwise(sizes))


def _inputs(sizes: Sequence[int]) -> float:
    """Of the gradients of all layers' inputs but the first's; a layer with one output only scales its kernel."""
    return sum(i * o for i, o in list(pairwise(sizes))[1:] if o > 1)


# ---- measured --------------------------------------------------------------------------------------------------------


@functools.cache
def product_rate(devices: tuple[jax.Device, ...], batch: int, inputs: int, outputs: int) -> float:
    """Floating point operations a second of all devices at once, in a layer's products of float32: forward, and the
    kernel's gradient. Takes some 0.3 s, most of it measuring."""
    mesh = jax.sharding.Mesh(np.array(devices), ("devices",))

    def products(count, x, kernel):
        # Each product needs the one before it, so that none can be left out.
        return jax.lax.fori_loop(0, count, lambda _, w: w - 1e-3 * (x[0].T @ (x[0] @ w)), kernel[0])[None]

    specs = (P(), P("devices"), P("devices"))
    program = jax.jit(jax.shard_map(products, mesh=mesh, in_specs=specs, out_specs=P("devices"), check_vma=False))
    x, kernel = (
        jax.device_put(np.full((len(devices), *shape), 0.01, np.float32), NamedSharding(mesh, P("devices")))
        for shape in ((batch, inputs), (inputs, outputs))
    )

    count, taken = _repeated(lambda count: program(jnp.int32(count), x, kernel), 0.2)
    return 4 * len(devices) * count * batch * inputs * outputs / taken


def physics_rate(env: Environment, devices: tuple[jax.Device, ...], robots: int) -> float | None:
    """Env steps/s of a robot's physics on one core of a CPU, all devices at once; None where it is not known.

    Args:
        robots: that each device steps together.
    """
    robot = innermost(env)
    physics = getattr(robot, "physics", None)
    if physics == "c" and hasattr(robot, "_engine"):
        return _c_rate(robot, devices, robots)
    return MJX_STEPS.get(str(physics))


def innermost(env: Any) -> Any:
    """The environment itself, out of all that wraps it."""
    while hasattr(env, "env"):
        env = env.env
    return env


def _c_rate(robot: Any, devices: tuple[jax.Device, ...], robots: int) -> float:
    """Measured in a compiled program, as the loop has it: calling C from it costs as much as several of its steps."""
    mesh = jax.sharding.Mesh(np.array(devices), ("devices",))
    model, together = robot.mj_model, min(robots, 64)
    low, high = model.actuator_ctrlrange.T
    controls = np.random.default_rng(0).uniform(low, high, (together, model.nu)).astype(np.float32)

    def advance(qpos, qvel, warmstart, control):
        after = robot._engine.advance(qpos, qvel, warmstart, control, robot.frame_skip, robot.reads)
        return after.qpos, after.qvel, after.qacc_warmstart

    def play(count):
        still = (jnp.asarray(model.qpos0, jnp.float32), *(jnp.zeros(model.nv) for _ in range(2)))
        start = tuple(jnp.broadcast_to(leaf, (together, *leaf.shape)) for leaf in still)
        return jax.lax.fori_loop(0, count, lambda _, state: jax.vmap(advance)(*state, controls), start)[0][None]

    program = jax.jit(jax.shard_map(play, mesh=mesh, in_specs=P(), out_specs=P("devices"), check_vma=False))
    count, taken = _repeated(lambda count: program(jnp.int32(count)), 0.1)
    return count * together / taken


def _repeated(program: Callable[[int], Any], wanted: float) -> tuple[int, float]:
    """(how often, seconds) of a program that repeats its work as often as its argument says, for some `wanted` seconds.

    In short calls: on a busy machine one that was quick may take a thousand times as long the next time.
    """

    def seconds(count: int) -> float:
        begun = time.perf_counter()
        jax.block_until_ready(program(count))
        return time.perf_counter() - begun

    count, times, taken = 1, 0, 0.0
    seconds(count)  # compiles
    while seconds(count) < 0.1 * wanted and count < 1000:
        count *= 4
    while taken < wanted:
        times, taken = times + count, taken + seconds(count)
    return times, taken


# ---- said ------------------------------------------------------------------------------------------------------------


def expectation(training: TrainingSession, done: int = 0) -> str:
    """How long the run is going to take after env step `done`, and how that is known, in a line."""
    trainer, layout = training.trainer, training.layout
    schedule = trainer.schedule
    if training.processes.size > 1 or not trainer.on_cpu:
        where = "several processes" if training.processes.size > 1 else "an accelerator"
        return f"expected: not estimated for {where}; the first interval shows the rate and the time left"
    group = max(layout.learning_groups, key=lambda g: _group(layout, schedule, g))
    critic = (update.critic_input_size(layout, group), *group.algorithm.hidden, group.critic.num_outputs)
    layer = max(pairwise(critic), key=lambda sizes: sizes[0] * sizes[1])
    # Larger products are done at the same rate, and take longer to measure.
    shape = (min(size, 1024) for size in (schedule.batch_size // trainer.sharding.devices_per_seed, *layer))
    used = tuple(trainer.mesh.devices.flat)
    products = product_rate(used, *shape)
    physics = physics_rate(training.env, used, trainer.sharding.local_seeds * schedule.num_envs)
    steps = training.total_steps - done
    learning = training.total_steps - max(done, trainer.schedule.warmup_steps)
    evaluations = training.evaluations_after(max(done, trainer.schedule.warmup_steps))
    if not done and training.eval_every:
        evaluations += 1  # of the untrained policies
    evaluated = evaluations * training.config.eval_episodes * training.env.episode_length
    updates = learning * schedule.updates_per_collect / schedule.rollout_steps
    flops = (steps + evaluated) * acting_flops(layout) + updates * update_flops(layout, schedule)
    seconds = trainer.sharding.padded_seeds * flops / (REACHED * products)
    how = f"products at {products / 1e9:.3g} GFLOP/s measured on these devices"
    if physics is None:
        how += "; the environment's own time is not counted"
    else:
        seconds += trainer.sharding.local_seeds * (steps + evaluated) / physics  # a device steps its own seeds
        how += f", physics {_rounded(physics):,} env steps/s a core"
    return f"expected: {duration(seconds)}, compiling apart ({how})"


def duration(seconds: float) -> str:
    """A length of time in words, as exact as an estimate can be."""
    if seconds < 60:
        return "under a minute"
    if seconds < 3600:
        minutes = round(seconds / 60)
        return f"about {minutes} minute{'s' * (minutes > 1)}"
    hours = seconds / 3600
    return f"about {hours:.1f} hours" if hours < 10 else f"about {hours:,.0f} hours"


def _rounded(number: float) -> int:
    """To two digits."""
    return int(float(f"{number:.2g}"))
