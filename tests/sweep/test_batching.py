"""Settings into runs and batches: what shares a program, what is missing, what fits; and the memory it takes."""

import dataclasses
import itertools
from pathlib import Path

import jax
import numpy as np
import pytest

from matd3_jax import config
from matd3_jax.errors import UserError
from matd3_jax.sweep import batching
from matd3_jax.training import memory
from matd3_jax.training.session import TrainingSession

BASE = ["env=simple_push", "seeds=2", "algo.hidden=[8]", "batch_size=16", "num_envs=2", "learning_starts=200",
        "replay_capacity=500", "total_steps=1500"]  # fmt: skip


def load(*more: str) -> config.Config:
    return config.load([*BASE, *more])


@pytest.mark.parametrize(
    "override",
    ["algo.lr=0.1", "algo.actor_lr=0.1", "algo.gamma=0.9", "algo.tau=0.5", "algo.logit_regularizer=0",
     "algo.max_grad_norm=1", "algo.exploration_noise=0.3", "algo.target_noise_clip=0.1", "seed=5", "seeds=7", "name=x",
     "out=elsewhere"],
)  # fmt: skip
def test_hyper_parameters_and_seeds_share_a_program(override):
    assert batching.program(load(override)) == batching.program(load())


@pytest.mark.parametrize(
    "override",
    ["algo.policy_delay=1", "algo.num_critics=1", "batch_size=32", "algo.hidden=[9]", "env.episode_length=50",
     "n_step=2", "total_steps=2000", "algo.target_noise=0.2", "num_envs=1", "log_every=100", "algo.adam=epsilon_hat",
     "diagnostics.q_bias=true", "adversary=maddpg", "algo=maddpg"],
)  # fmt: skip
def test_shapes_and_schedules_do_not(override):
    assert batching.program(load(override)) != batching.program(load())


def test_lengths_of_the_others_step_share_a_program_but_none_is_another():
    one, other, team, none = (
        batching.program(load("algo=m3ddpg", *steps))
        for steps in (
            [],
            ["algo.adversarial_step=0.1", "algo.adversarial_step_team=0"],
            ["algo.adversarial_step=0"],
            ["algo.adversarial_step=0", "algo.adversarial_step_team=0"],
        )
    )
    assert one == other == team != none


@pytest.mark.slow
def test_settings_that_share_a_program_compile_to_the_same_text():
    """What `program` says is what XLA sees: the lowered interval does not depend on the members' numbers."""

    def lowered(*more: str) -> str:
        training = TrainingSession(load(*more))
        state = jax.eval_shape(training.trainer.init, jax.eval_shape(training.keys))
        return training.interval.jitted.lower(state, training.trainer.hyper).as_text()

    assert lowered("algo.lr=0.3", "algo.tau=0.5", "algo.gamma=0.1") == lowered()
    assert lowered("algo.target_noise=0.2") != lowered()
    # Without a step M3DDPG is MADDPG and M3MATD3 is MATD3: the same program, hence the same run to the bit.
    still = ("algo.adversarial_step=0", "algo.adversarial_step_team=0")
    assert lowered("algo=m3matd3", *still) == lowered() != lowered("algo=m3matd3")
    assert lowered("algo=m3ddpg", *still) == lowered("algo=maddpg")


def test_only_missing_seeds_are_planned(tmp_path):
    existing = {"a": load("seed=0", "seeds=3"), "other": load("algo.lr=0.1", "seeds=9"), "b": load("seed=5", "seeds=1")}
    assert batching.missing(load("seeds=7"), existing) == (["a", "b"], [3, 4, 6])
    batches = batching.batches({"new": load("seeds=7")}, existing, tmp_path, lambda config: 100)
    assert [[(run.name, run.seed, run.seeds) for run in batch] for batch in batches] == [
        [("new-seeds_3_to_4", 3, 2), ("new-seeds_6_to_6", 6, 1)]
    ]
    assert batching.batches({"new": load("seeds=3")}, existing, tmp_path, lambda config: 100) == []
    with pytest.raises(UserError, match="seed 2"):
        batching.missing(load("seeds=7"), {**existing, "again": load("seed=2", "seeds=1")})


def test_seeds_that_do_not_fit_are_cut(tmp_path):
    batches = batching.batches(
        {"x": load("seeds=10"), "y": load("algo.lr=1", "seeds=3")}, {}, tmp_path, lambda config: 4
    )
    runs = [run for batch in batches for run in batch]
    assert all(sum(run.seeds for run in batch) <= 4 for batch in batches)
    covered = [(run.algo.actor_lr, seed) for run in runs for seed in range(run.seed, run.seed + run.seeds)]
    assert sorted(covered) == sorted([(0.01, s) for s in range(10)] + [(1.0, s) for s in range(3)])
    assert {Path(run.out) for run in runs} == {tmp_path} and len({run.name for run in runs}) == len(runs)


def test_packing_takes_no_more_batches_than_needed():
    """Against every way to cut the sequence of runs into consecutive batches."""
    rng = np.random.default_rng(0)
    for _ in range(60):
        sizes = rng.integers(1, 5, rng.integers(1, 8))
        most = int(rng.integers(sizes.max(), 10))
        runs = [dataclasses.replace(load(), seeds=int(n), name=str(k)) for k, n in enumerate(sizes)]
        found = batching.packed(runs, most)
        assert [run for batch in found for run in batch] == runs

        def fits(cuts, sizes=sizes, most=most):
            ends = [0, *cuts, len(sizes)]
            return all(sizes[a:b].sum() <= most for a, b in zip(ends, ends[1:], strict=False))

        fewest = next(
            n for n in range(len(sizes)) if any(fits(c) for c in itertools.combinations(range(1, len(sizes)), n))
        )
        assert len(found) == fewest + 1
        assert all(sum(run.seeds for run in batch) <= most for batch in found)


# ---- memory ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [
        ["seeds=6", "env=simple_spread", "algo.hidden=[64,64]", "batch_size=256"],
        ["seeds=2", "n_step=3", "diagnostics.q_bias=true", "normalize_observations=true"],
        ["seeds=2", "env=simple_spread", "algo.actor=gru", "algo.hidden=[64,64]", "batch_size=256"],
        # Networks are kept besides.
        ["seeds=4", "algo.hidden=[256,256]", "batch_size=16", "on_divergence=stop_seed", "algo.policy_delay=1"],
    ],
)
def test_the_computed_memory_covers_the_compiled_program(more):
    """Arguments and temporaries that XLA reserves for the interval lie below what is computed beforehand, and the
    replay is most of both where it is large."""
    training = TrainingSession(load("replay_capacity=20000", "total_steps=20000", *more))
    trainer, seeds = training.trainer, len(training.seeds)
    state = jax.eval_shape(trainer.init, jax.eval_shape(training.keys))
    analysis = training.interval.jitted.lower(state, trainer.hyper).compile().memory_analysis()
    used = trainer.mesh.size * (analysis.argument_size_in_bytes + analysis.temp_size_in_bytes)
    computed = memory.needed(trainer, seeds) - memory.PROCESS
    assert trainer.replay_bytes < used <= computed
    assert computed <= 2 * used + 2 * trainer.replay_bytes / seeds


def test_the_computed_memory_has_the_policies_that_are_kept():
    """Of both teams, with what observations are normalized by: one seed's arrays are counted as they are written down,
    for every seed and twice, since they are taken over before the old ones go."""
    training = TrainingSession(load("normalize_observations=true", "adversary=maddpg", "adversary.hidden=[5]"))
    state = training.trainer.init(training.keys())
    training.best.note(0, state, np.zeros((2, 4, training.layout.num_agents)))
    written = sum(array.nbytes for found in training.best.found for array in found.policies.values())
    actors = 4 * sum(seen * hidden + hidden + hidden * 5 + 5 for seen, hidden in ((19, 8), (8, 5)))
    assert written > actors + 4 * 2 * (19 + 8)
    assert memory.parts(training.trainer, 2)["best"].size == 2 * written
    assert memory.parts(training.trainer, 6)["best"].size == 3 * 2 * written


def test_the_most_seeds_are_those_that_just_fit():
    trainer = TrainingSession(load("replay_capacity=100000", "total_steps=100000")).trainer
    for budget in (memory.needed(trainer, 1), memory.needed(trainer, 5) + 1, memory.PROCESS + 10**9):
        seeds = memory.most_seeds(trainer, budget)
        assert memory.needed(trainer, seeds) <= budget
        assert memory.needed(trainer, seeds + len(jax.devices())) > budget
    with pytest.raises(UserError, match="one seed needs"):
        memory.most_seeds(trainer, memory.needed(trainer, 1) - 1)
