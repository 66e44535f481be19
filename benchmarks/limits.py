"""`python -m benchmarks.limits`: what this machine could do at most: the least time of one iteration of training.

Other keys are settings of the run, as `python -m matd3_jax.train` takes them. Measured in the same run, on the same
devices: the rate of every matrix product of the loop, by itself and at its own shape (batched over seeds, agents and
twins as the loop has them; on one device alone, and on all at once), and the memory's bandwidth. From these and the
products of one iteration, counted by hand and again in the compiled program, follows the roofline: the time that the
products alone take, or the bytes that must be moved at least, whichever is more. Nothing else is in it: no bias, no
ReLU, no random numbers, no sampling, no optimizer, no environment.
"""

import dataclasses
import functools
import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.commit import commit
from benchmarks.loop import product_flops
from benchmarks.options import OfARun
from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.core import update
from matd3_jax.core.group import Group
from matd3_jax.errors import UserError
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say
from matd3_jax.training import memory
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.session import TrainingSession


@dataclasses.dataclass(frozen=True)
class Options(OfARun):
    """Options of this benchmark."""

    seeds: int = option("side by side", default=20, least=1)
    repeats: int = option("of each measurement", default=5, least=1)


COMMAND = Command("python -m benchmarks.limits", Options, __doc__)


@dataclasses.dataclass(frozen=True)
class Product:
    """A kind of matrix product: `equation` as einsum takes it, of operands with these shapes."""

    equation: str
    left: tuple[int, ...]
    right: tuple[int, ...]

    @property
    def flops(self) -> int:
        """Two for each multiplication and addition."""
        names = self.equation.split("->")[0].replace(",", "")
        return 2 * math.prod(dict(zip(names, self.left + self.right, strict=True)).values())


@dataclasses.dataclass(frozen=True)
class Roofline:
    """The least time of one iteration of all seeds together, seconds."""

    alone: float
    """Products, every device as fast as it is when the others rest."""
    together: float
    """Products, all devices at once."""
    moved: float
    """Bytes that must be read or written, all devices at once."""
    flops: float
    """Of the products of one iteration, all seeds."""

    @property
    def seconds(self) -> float:
        return max(self.alone, self.moved)

    @property
    def gflops(self) -> float:
        """Giga floating point operations a second of the products of the loop, every device as when alone."""
        return self.flops / self.alone / 1e9


# ---- counted by hand -------------------------------------------------------------------------------------------------


def products(trainer: TrainLoop, part: str = "loop") -> dict[Product, float]:
    """How many of each product one device does in one iteration: of the "rollout", the "update", or the whole
    "loop"."""
    schedule, layout = trainer.schedule, trainer.layout
    if layout.recurrent:
        raise UserError(
            "actor=gru: the products of perceptrons alone are counted one by one (training.cost counts all)"
        )
    found: dict[Product, float] = {}
    local = trainer.sharding.local_seeds
    updates = trainer.rollouts_per_iteration * schedule.updates_per_collect
    for group in layout.groups:
        together = trainer.sharding.seeds_together * (1 if trainer.on_cpu else len(group.members))
        times = local * len(group.members) / together * updates
        for product, share in _update(trainer, group) if part != "rollout" else ():
            batched = _batched(product, together)
            found[batched] = found.get(batched, 0) + times * share
        sizes = (group.observation_size, *group.algorithm.hidden, group.action_space.size)
        acting = _forward((local, len(group.members)), schedule.num_envs, sizes) if part != "update" else []
        for product in acting:
            found[product] = found.get(product, 0) + trainer.rollouts_per_iteration * schedule.rollout_length
    return found


def _update(trainer: TrainLoop, group: Group) -> Iterator[tuple[Product, float]]:
    """(product, how many an update) of one agent of the group: see `core.losses`."""
    layout, algorithm = trainer.layout, group.algorithm
    batch = trainer.schedule.batch_size // trainer.sharding.devices_per_seed
    hidden, delay = algorithm.hidden, algorithm.policy_delay
    central, g = algorithm.central, layout.groups.index(group)
    # With one minibatch for all, the members of a group share their target actions.
    shared = len(group.members) if trainer.schedule.shared_minibatch and central else 1
    # A team's one set of critics, of which each member of its first group has a part here.
    judging = (float(layout.critic_group(g) == g) / len(group.members)) if group.team_critic else 1.0
    if group.team_critic:
        shared = 1
    for other in layout.groups if central else (group,):
        sizes = (other.observation_size, *other.algorithm.hidden, other.action_space.size)
        members = (len(other.members),) if central else ()
        yield from ((part, judging / shared) for part in _forward(members, batch, sizes))
    critic = (update.critic_input_size(layout, group), *hidden, group.critic.num_outputs)
    twins = algorithm.num_critics
    targets, climbed = algorithm.critics_in_target, algorithm.critics_climbed
    every, target, first = (_first_to_last(number, batch, critic) for number in (twins, targets, climbed))
    yield from ((part, judging) for part in target + every)
    yield Product("bi,bo->io", (batch, critic[0]), (batch, twins * critic[1])), judging
    yield from ((part, judging) for part in _backward((twins,), batch, critic)[1:])
    if algorithm.adversarial:
        # The slopes by which others' actions are moved: of the target's critics, and of those that the actor climbs.
        yield from ((part, 1) for part in [*target, *_back_to_inputs(targets, batch, critic)])
        values = algorithm.critic_head == "categorical"  # elsewhere the slope of a mean needs no outputs
        yield from ((part, 1 / delay) for part in (first if values else first[:-1]))
        yield from ((part, 1 / delay) for part in _back_to_inputs(climbed, batch, critic))
    for other in layout.learning_groups if trainer.schedule.random_order and central else ():
        # What everybody does by now, before each actor moves.
        sizes = (other.observation_size, *other.algorithm.hidden, other.action_space.size)
        yield from ((part, 1 / delay) for part in _forward((len(other.members),), batch, sizes))
    k = group.action_space.size
    actor = (group.observation_size, *hidden, k)
    width = climbed * critic[1]
    # All actors of a team climb one product of what was replayed, unless they look at the others' policies of then.
    once = judging if not trainer.schedule.random_order else 1.0
    yield first[0], once / delay
    yield from ((part, 1 / delay) for part in _forward((), batch, actor) + first[1:])
    yield Product("bi,io->bo", (batch, k), (k, width)), 1 / delay  # the own action's change
    yield Product("bo,io->bi", (batch, width), (k, width)), 1 / delay
    yield from ((part, 1 / delay) for part in _backward((climbed,), batch, critic)[1:] if part.equation.endswith("bi"))
    yield from ((part, 1 / delay) for part in _backward((), batch, actor))


def _forward(stack: tuple[int, ...], batch: int, sizes: Sequence[int]) -> list[Product]:
    """The products of perceptrons' layers, [*stack, batch, i] times [*stack, i, o]."""
    s = "st"[: len(stack)]
    return [
        Product(f"{s}bi,{s}io->{s}bo", (*stack, batch, i), (*stack, i, o))
        for i, o in zip(sizes[:-1], sizes[1:], strict=True)
    ]


def _first_to_last(stack: int, batch: int, sizes: Sequence[int]) -> list[Product]:
    """The layers of a stack that reads the same input: the first ones are one wide product."""
    wide = Product("bi,io->bo", (batch, sizes[0]), (sizes[0], stack * sizes[1]))
    return [wide, *_forward((stack,), batch, sizes)[1:]]


def _backward(stack: tuple[int, ...], batch: int, sizes: Sequence[int]) -> list[Product]:
    """Gradients of every layer's kernel, and of the inputs of all but the first; products with a vector of length one
    on the way back are scalings, no products."""
    s = "st"[: len(stack)]
    kernels, inputs = [], []
    for layer, (i, o) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        kernels.append(Product(f"{s}bi,{s}bo->{s}io", (*stack, batch, i), (*stack, batch, o)))
        if layer > 0 and o > 1:
            inputs.append(Product(f"{s}bo,{s}io->{s}bi", (*stack, batch, o), (*stack, i, o)))
    return kernels + inputs


def _back_to_inputs(twins: int, batch: int, sizes: Sequence[int]) -> list[Product]:
    """Gradients of the inputs of every layer, the first's of all twins at once."""
    later = [part for part in _backward((twins,), batch, sizes) if part.equation.endswith("bi")]
    return [*later, Product("bo,io->bi", (batch, twins * sizes[1]), (sizes[0], twins * sizes[1]))]


def _batched(product: Product, together: int) -> Product:
    """The product for several seeds (and members) at once."""
    if together == 1:
        return product
    left, right = product.equation.split("->")[0].split(",")
    out = product.equation.split("->")[1]
    return Product(f"n{left},n{right}->n{out}", (together, *product.left), (together, *product.right))


def least_bytes(trainer: TrainLoop, part: str = "loop") -> int:
    """Bytes of one iteration, all seeds, that cannot stay in a cache: minibatches read from the replay, new rows
    written, networks and optimizers read and written once an update (twice for what is moved along)."""
    schedule, layout = trainer.schedule, trainer.layout
    batches = 1 if schedule.shared_minibatch else layout.num_minibatches
    state = memory.size(trainer.abstract_state().groups) // trainer.sharding.padded_seeds
    written = 4 * layout.row_size * schedule.rollout_steps
    read = schedule.updates_per_collect * (4 * layout.row_size * batches * schedule.batch_size + 2 * state)
    return (
        trainer.sharding.padded_seeds
        * trainer.rollouts_per_iteration
        * {"rollout": written, "update": read, "loop": written + read}[part]
    )


# ---- counted in the compiled program ---------------------------------------------------------------------------------


def counted_flops(text: str) -> float:
    """Floating point operations of the matrix products in a compiled program (HLO text as `Compiled.as_text` gives it),
    loops as often as they run. Raises ValueError where XLA does not say how often."""
    bodies: dict[str, list[str]] = {}
    entry = name = ""
    for line in text.splitlines():
        head = re.match(r"(ENTRY )?%?([\w.\-]+) .*\{$", line)
        if head and not line.startswith(" "):
            name = head[2]
            bodies[name] = []
            entry = name if head[1] else entry
        elif name:
            bodies[name].append(line)
    shape = re.compile(r"%?([\w.\-]+) = \w+\[([\d,]*)\]")
    totals: dict[str, float] = {}

    def total(name: str) -> float:
        if name in totals:
            return totals[name]
        sizes = {m[1]: _numbers(m[2]) for m in map(shape.search, bodies[name]) if m}
        flops = 0.0
        for line in bodies[name]:
            dot = re.search(r" dot\(%?([\w.\-]+),.*lhs_contracting_dims=\{([\d,]*)\}", line)
            if dot:
                out = shape.search(line)
                contracted = math.prod(sizes[dot[1]][d] for d in _numbers(dot[2]))
                flops += 2 * math.prod(_numbers(out[2])) * contracted  # type: ignore[index]
            called = re.findall(r"(?:calls|to_apply|body|condition)=%?([\w.\-]+)", line)
            times = 1
            if " while(" in line:
                count = re.search(r'"known_trip_count":\{"n":"(\d+)"', line)
                if not count and any(total(c) for c in called):
                    raise ValueError(f"a loop with products in it and no known count: {line.strip()[:120]}")
                times = int(count[1]) if count else 1
            flops += times * sum(total(c) for c in called)
        totals[name] = flops
        return flops

    return total(entry)


def _numbers(text: str) -> list[int]:
    return [int(n) for n in text.split(",") if n]


def compiled_flops(trainer: TrainLoop) -> float:
    """`counted_flops` of one iteration of all seeds. On accelerators, where products are calls into libraries, those of
    the traced program."""
    state = trainer.abstract_state()
    shape = (trainer.sharding.padded_seeds, trainer.schedule.replay_capacity, trainer.layout.row_size)
    state = state._replace(replay=jax.ShapeDtypeStruct(shape, jnp.float32))
    iterations = 2  # a loop that runs once may be unrolled
    traced = trainer.interval(iterations).jitted.trace(state, trainer.hyper)
    if not trainer.on_cpu:
        return product_flops(traced.jaxpr.jaxpr) / iterations
    # What LLVM does afterwards changes no product.
    quick = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
    text = traced.lower().compile(quick).as_text()
    return counted_flops(text) / iterations * trainer.mesh.size


# ---- measured --------------------------------------------------------------------------------------------------------


def seconds(product: Product, count: int, repeats: int = 5) -> float:
    """Seconds of one product on each of `count` devices at the same time, median."""
    call, times = _repeated(product, count)
    return _median(call, repeats) / times


@functools.cache
def _repeated(product: Product, count: int) -> tuple[Callable[[], Any], int]:
    """What does a product many times on each of `count` devices, and how many times. Operands come one after the other
    from a set of eight (fewer where they are large), so that they are no warmer in cache than in the loop."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:count]), ("devices",))
    layout = jax.sharding.PartitionSpec("devices")
    sets = max(1, min(8, 2**26 // (math.prod(product.left) + math.prod(product.right))))
    rounds = max(1, round(0.02 * 50e9 / (product.flops * sets)))

    def rounds_of(left, right):
        def one(total, operands):
            return total + jnp.einsum(product.equation, *operands).ravel()[0], None

        return jax.lax.scan(lambda t, _: jax.lax.scan(one, t, (left[0], right[0])), jnp.zeros(()), None, rounds)[0]

    program = jax.jit(
        jax.shard_map(lambda a, b: rounds_of(a, b)[None], mesh=mesh, in_specs=layout, out_specs=layout, check_vma=False)
    )
    left, right = (
        jax.device_put(np.full((count, sets, *shape), 0.01, np.float32), jax.sharding.NamedSharding(mesh, layout))
        for shape in (product.left, product.right)
    )
    call = functools.partial(program, left, right)
    jax.block_until_ready(call())
    return call, rounds * sets


@functools.cache
def bandwidth(repeats: int = 5, mebibytes: int = 256) -> float:
    """Bytes a second that all devices together read and write (x + 1 over an array far larger than any cache)."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("devices",))
    layout = jax.sharding.PartitionSpec("devices")
    x = jax.device_put(
        np.zeros((jax.device_count(), mebibytes * 2**18), np.float32), jax.sharding.NamedSharding(mesh, layout)
    )
    program = jax.jit(jax.shard_map(lambda x: x + 1, mesh=mesh, in_specs=layout, out_specs=layout))
    return 2 * x.nbytes / _median(lambda: program(x), repeats)


def _median(call: Callable[[], Any], repeats: int) -> float:
    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - begun)
    return float(np.median(times))


def roofline(trainer: TrainLoop, repeats: int = 5, part: str = "loop") -> tuple[Roofline, list[dict[str, Any]]]:
    """The roofline of one iteration, or of a part of it (see `products`), and a row for every kind of product."""
    devices_used = trainer.mesh.size
    rows = []
    for product, count in products(trainer, part).items():
        alone = seconds(product, 1, repeats)
        together = seconds(product, devices_used, repeats) if devices_used > 1 else alone
        rows.append({
            "equation": product.equation, "left": product.left, "right": product.right, "count": count,
            "flops": product.flops, "seconds_alone": alone, "seconds_together": together,
        })  # fmt: skip
    flops = devices_used * sum(row["count"] * row["flops"] for row in rows)
    alone, together = (sum(row["count"] * row[f"seconds_{how}"] for row in rows) for how in ("alone", "together"))
    return Roofline(alone, together, least_bytes(trainer, part) / bandwidth(repeats), flops), rows


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    devices.prepare()
    line = [f"seeds={options.seeds}", "total_steps=100000", "eval_every=0", *options.overrides]
    settings = config.load(line, COMMAND.keys)
    trainer = TrainingSession(settings).trainer
    report: dict[str, Any] = {"machine": devices.description(), "versions": devices.versions()}
    report |= {"commit": commit(), "settings": list(argv)}
    found, rows = roofline(trainer, options.repeats)
    for row in sorted(rows, key=lambda row: -row["count"] * row["seconds_alone"]):
        shapes = f"{row['equation']:<14} {list(row['left'])} {list(row['right'])}"
        say(f"{shapes:<56} {row['flops'] / row['seconds_alone'] / 1e9:8.1f} GFLOP/s alone "
              f"{row['flops'] / row['seconds_together'] / 1e9:8.1f} each of {trainer.mesh.size} at once   "
              f"{row['count'] * row['seconds_alone'] / found.alone:6.1%} of the roofline")  # fmt: skip
    steps = trainer.num_seeds * trainer.iteration_steps
    counted = compiled_flops(trainer)
    report |= {"floor": dataclasses.asdict(found), "products": rows, "flops_in_compiled_program": counted}
    report["env_steps_per_second"] = steps / found.seconds
    say(f"products of one env step: {found.flops / steps / 1e6:.3f} MFLOP by hand, "
          f"{counted / steps / 1e6:.3f} in the compiled program")  # fmt: skip
    say(f"least time of an iteration ({steps:,} env steps): products {found.alone * 1e3:.2f} ms (devices as when "
          f"alone; {found.together * 1e3:.2f} all at once), memory {found.moved * 1e3:.2f} ms")  # fmt: skip
    say(f"at most {steps / found.seconds:,.0f} env steps/s, at {found.gflops:.0f} GFLOP/s")
    options.write(report)
    return 0


if __name__ == "__main__":
    sys.argv[0] = "limits"
    command.run(main, COMMAND)
