"""Runs and sweeps with the critics that are no default: resumed to the bit, swept, measured by the Q-bias."""

import csv
from pathlib import Path

import pytest
from checkpoint_arrays import assert_resumes_to_the_bit

from matd3_jax import config
from matd3_jax.cli import sweep, train
from matd3_jax.sweep import batching
from matd3_jax.sweep.runner import Sweep

TINY = [
    "env=simple_push", "adversary=maddpg", "seeds=2", "algo.hidden=[8]", "adversary.hidden=[8]", "batch_size=16",
    "num_envs=2", "learning_starts=200", "replay_capacity=500", "total_steps=600", "log_every=100", "eval_every=300",
    "eval_episodes=2", "algo.policy_delay=1",
]  # fmt: skip
QUANTILES = [
    "adversary.critic_head=quantile", "adversary.critic_quantiles=5", "adversary.num_critics=3",
    "adversary.target_critics=2", "adversary.actor_critics=all",
]  # fmt: skip
DISTRIBUTION = ["algo.critic_range=[-60,5]", "algo.critic_atoms=9", "adversary.critic_norm=layer"]


@pytest.mark.slow
def test_resumed_to_the_bit(tmp_path):
    """A categorical team against one with quantiles and layer normalization, Q-bias measured on the way."""
    line = [
        *TINY,
        *DISTRIBUTION,
        *QUANTILES,
        "algo.critic_head=categorical",
        "diagnostics.q_bias=true",
        f"out={tmp_path}",
    ]
    assert train.main([*line, "name=whole", "checkpoint_every=300", "keep_checkpoints=3"]) == 0
    whole = tmp_path / "whole"
    assert_resumes_to_the_bit(whole, tmp_path / "cut")
    with (whole / "metrics.csv").open(newline="") as file:
        last = list(csv.DictReader(file))[-1]
    # A cross-entropy over 9 atoms starts near ln 9; values are means of returns within the range.
    assert 0 < float(last["adversary_0_critic_loss"]) and 0 < float(last["agent_0_critic_loss"]) < 3
    assert -60 < float(last["agent_0_q_value"]) < 5


@pytest.mark.slow
def test_swept(tmp_path: Path):
    """Each head is a program of its own, and learns as the same run made alone; so is each norm."""
    line = [*TINY, *DISTRIBUTION[:2]]
    heads = ["algo.critic_head=scalar,categorical", "adversary.critic_norm=layer"]
    assert sweep.main([*line, *heads, f"out={tmp_path}", "name=heads"]) == 0
    folder = tmp_path / "heads"
    assert [len(batch) for batch in Sweep(folder).batches] == [1, 1]
    assert train.main([*line, "algo.critic_head=categorical", heads[1], f"out={tmp_path}"]) == 0
    alone = next(path for path in tmp_path.iterdir() if path.name != "heads")
    (member,) = (folder / "runs").glob("*categorical*")
    assert (member / "metrics.csv").read_bytes() == (alone / "metrics.csv").read_bytes()
    settings = config.read(member / "config.yaml")
    assert settings.algo.critic_head == "categorical" and settings.adversary.critic_norm == "layer"
    plain = config.load([*line, "algo.critic_head=categorical"])
    assert batching.program(plain) != batching.program(config.load([*line, "algo.critic_head=categorical", heads[1]]))
