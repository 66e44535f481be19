"""What the compiler makes of an interval: one program, and no copy of the replay in its loop."""

import math
import re

import jax
import jax.numpy as jnp
import pytest
from ledger import HYPER

from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs import make
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.schedule import Schedule

CAPACITY = 6 * 1361  # a number that nothing else in the program has
IN_PLACE = {"parameter", "get-tuple-element", "tuple", "bitcast", "dynamic-update-slice", "while", "call"}
"""What gives out an array of the replay's size without writing all of it."""


CASES = [pytest.param((1, 1), marks=pytest.mark.slow), (2, 1), pytest.param((2, 3), marks=pytest.mark.slow)]


@pytest.fixture(scope="module", params=CASES, ids="seeds={0[0]} n_step={0[1]}".format)
def trainer(request):
    """Of one seed or two on one device: their loops are compiled differently."""
    env = make("point_reach", dim=1)
    seeds, n_step = request.param
    layout = JointLayout.of(env, {"agents": Algorithm(hidden=(4,), smoothing=True)}, n_step)
    schedule = Schedule(num_envs=2, rollout_length=3, batch_size=8, replay_capacity=CAPACITY, learning_starts=1)
    return TrainLoop(env, layout, schedule, {"agents": HYPER}, seeds, devices=jax.devices()[:1])


def start(trainer):
    return trainer.init(jax.vmap(jax.random.key)(jnp.arange(trainer.num_seeds)))


@pytest.fixture(scope="module")
def compiled(trainer):
    """The interval as XLA compiles it; machine code is not looked at and may be as slow as it likes."""
    program = trainer.interval(2)
    options = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
    return program.jitted.lower(start(trainer), program.hyper).compile(compiler_options=options)


def computations(text):
    """{name: [(shape, opcode, line)]} of the computations of an HLO module."""
    found, current = {}, None
    for line in text.splitlines():
        if head := re.match(r"(?:ENTRY )?%?([\w.\-]+) .*\{$", line):
            current = found.setdefault(head[1], [])
        elif (op := re.match(r"\s+(?:ROOT )?%?[\w.\-]+ = (\(.*?\)|\S+) ([\w\-]+)\(", line)) and current is not None:
            current.append((op[1], op[2], line))
    return found


def in_loops(found):
    """Names of the computations that run within a while loop."""
    reached = set()
    waiting = [name for ops in found.values() for _, code, line in ops if code == "while"
               for name in re.findall(r"(?:body|condition)=%?([\w.\-]+)", line)]  # fmt: skip
    while waiting:
        if (name := waiting.pop()) not in reached:
            reached.add(name)
            for _, _, line in found[name]:
                waiting += [n for n in re.findall(r"%([\w.\-]+)", line) if n in found]
    return reached


@pytest.mark.slow
def test_replay_is_never_copied_in_the_loop(compiled):
    """Nothing in the loop gives out an array of the replay's size but writes in place: no copy, select, scatter (what
    `cond` and `vmap` make of a conditional or a batched write), nor a fusion around one. 200 MB an iteration
    otherwise."""
    found = computations(compiled.as_text())
    loops = in_loops(found)
    assert loops
    of_replay = [
        (code, line) for name in loops for shape, code, line in found[name] if str(CAPACITY) in re.split(r"\D", shape)
    ]
    assert any(code == "dynamic-update-slice" for code, _ in of_replay), "the write itself was not found"
    for code, line in of_replay:
        if code == "fusion":
            inner = found[re.search(r"calls=%?([\w.\-]+)", line)[1]]
            assert any(c == "dynamic-update-slice" for _, c, _ in inner), line
        else:
            assert code in IN_PLACE, line


def test_memory(trainer, compiled):
    """The replay given in is the replay given out (donated), and the program needs far less besides."""
    memory = compiled.memory_analysis()
    assert trainer.replay_bytes == 4 * trainer.num_seeds * CAPACITY * trainer.layout.row_size
    assert memory.alias_size_in_bytes >= trainer.replay_bytes
    assert memory.temp_size_in_bytes < trainer.replay_bytes / 3


@pytest.mark.slow
def test_one_compilation_and_donation(trainer):
    """An interval is compiled with its first call and never again, though states come from `init`, `warm-up` and from
    itself; each state given in is gone after it, in every leaf."""
    if trainer.num_seeds == 1 or trainer.layout.n_step > 1:
        pytest.skip("the same for any number of seeds or steps")
    compiles = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: compiles.append(event) if "backend_compile" in event else None
    )
    interval = trainer.interval(2)
    states = [start(trainer)]
    for repetition in range(3):
        before = len(compiles)
        state, metrics = interval(states[-1])
        jax.block_until_ready(metrics)
        assert (len(compiles) - before > 0) == (repetition == 0)
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(states[-1]) if math.prod(leaf.shape) > 1)
        states.append(state)
    before = len(compiles)
    prefilled, _ = trainer.warm_up(start(trainer))
    used = len(compiles)
    interval(prefilled)
    assert len(compiles) == used > before
