"""Hybrid runs: the agents of a team until switch_at, one agent in their place from then on."""

import csv
import os
import shutil
import signal

import jax
import numpy as np
import pytest
from checkpoint_arrays import assert_same_run

from matd3_jax import config
from matd3_jax.cli import evaluate, sweep, train
from matd3_jax.core import acting
from matd3_jax.errors import UserError
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.training import checkpoint, hybrid
from matd3_jax.training.session import TrainingSession
from matd3_jax.training.train import train as train_here

pytestmark = pytest.mark.slow

TINY = [
    "env=simple_adversary", "algo=hybrid", "adversary=maddpg", "algo.hidden=[6]", "adversary.hidden=[5]",
    "batch_size=16", "num_envs=2", "rollout_length=5", "learning_starts=200", "replay_capacity=500", "log_every=100",
    "seeds=2", "eval_every=200", "eval_episodes=2", "checkpoint_every=200",
]  # fmt: skip
SPREAD = [
    "env=simple_spread", "algo=hybrid", "algo.hidden=[6,4]", "algo.actor_average=0.1", "batch_size=16", "num_envs=2",
    "rollout_length=5", "learning_starts=200", "replay_capacity=900", "log_every=100", "seeds=2", "eval_every=200",
    "eval_episodes=2", "checkpoint_every=200", "normalize_observations=true", "n_step=3", "total_steps=1090",
    "switch_at=540", "diagnostics.q_bias=true", "diagnostics.q_bias_rollouts=5", "diagnostics.q_bias_steps=3",
    "updates_per_collect=2",
]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A finished run: three agents to env step 490 or 590, then one."""
    out = tmp_path_factory.mktemp("runs")
    assert train.main([*SPREAD, f"out={out}", "name=whole"]) == 0
    return out / "whole"


def sessions(path):
    """The sessions of a run and of its agents' part."""
    return tuple(TrainingSession(config.read(one / "config.yaml")) for one in (path, path / hybrid.FOLDER))


def rows(path):
    with (path / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def handed_over(whole):
    """(session, state) of the one agent at the switch, and of the agents."""
    one, agents = sessions(whole)
    saved = checkpoint.verify(whole / hybrid.FOLDER / "checkpoints")
    before = checkpoint.restore(saved, agents.trainer)
    return (one, hybrid.begin(one, agents, saved)), (agents, before)


def test_the_switch_is_at_the_end_of_the_nearest_interval(whole):
    one, agents = sessions(whole)
    table = rows(whole)
    steps = sorted({int(row["step"]) for row in table})
    assert steps == list(range(190, steps[-1] + 1, 100)) and steps[-1] == one.total_steps == 1090
    assert agents.total_steps == 590 == hybrid.switch_step(one)
    assert agents.config.algo.name == "matd3" and agents.config.algo.critic == "central"
    assert agents.layout.num_agents == 3 and one.layout.agents == ("agents",)
    assert one.layout.algorithms[0].hidden == (18, 12) and agents.layout.algorithms[0].hidden == (6, 4)


def test_one_agent_does_what_the_agents_did(handed_over):
    (one, after), (agents, before) = handed_over
    keys = jax.random.split(jax.random.key(5), 3)
    observation = [np.asarray(jax.random.normal(key, (9, 18))) for key in keys]
    for average in (False, True):
        mine, theirs = (s.trainer.policy(state, average=average) for s, state in ((one, after), (agents, before)))
        for seed in range(2):
            found, wanted = (
                acting.act(s.layout, jax.tree.map(lambda leaf, k=seed: leaf[k], policy), seen, None)
                for s, policy, seen in (
                    (one, mine, [np.concatenate(observation, axis=-1)]),
                    (agents, theirs, observation),
                )
            )
            np.testing.assert_allclose(found, wanted, atol=2e-6)
            assert np.std(wanted) > 1e-3


def test_moments_go_on_as_those_of_the_joined_losses(handed_over):
    """A value that counts a third has a third of the gradient in hidden layers, and the same in the last."""
    (_, after), (_, before) = handed_over
    old, new = before.groups[0], after.groups[0]
    for kind, share in (("actor", 1.0), ("critic", 1 / 3)):
        mine, theirs = (getattr(group, f"{kind}_optimizer") for group in (new, old))
        np.testing.assert_array_equal(mine.count[:, 0], theirs.count[:, 0])
        for moment, power in (("mu", 1), ("nu", 2)):
            a, b = (jax.tree.map(np.asarray, getattr(m, moment)) for m in (mine, theirs))
            for i in range(3):  # the second hidden layer: 6 units to 4 of each agent
                block = a["kernel_1"][:, 0, ..., 6 * i : 6 * i + 6, 4 * i : 4 * i + 4]
                np.testing.assert_allclose(block, share**power * b["kernel_1"][:, i], rtol=1e-5)
            between = a["kernel_1"][:, 0, ..., :6, 4:]
            mean = share**power * b["kernel_1"].mean(axis=(-2, -1)).mean(axis=1)
            wanted = mean[..., None, None] if moment == "nu" else 0
            np.testing.assert_allclose(between, np.broadcast_to(wanted, between.shape), rtol=1e-5)
            if kind == "critic":
                np.testing.assert_allclose(a["kernel_2"][:, 0, :, 4:8], b["kernel_2"][:, 1], rtol=1e-5)


def test_the_replay_the_episodes_and_the_statistics_go_on(handed_over):
    (one, after), (agents, before) = handed_over
    old, new = np.asarray(before.replay), np.asarray(after.replay)
    filled = 590
    np.testing.assert_array_equal(new[:, filled:], 0)
    assert new.shape[1] == 900 and int(after.rollouts) == int(before.rollouts) == 59
    x, a, n = 54, 15, 3  # simple_spread: three agents that see 18 numbers and choose among 5
    old, new = old[:, :filled], new[:, :filled]
    np.testing.assert_array_equal(new[..., : x + a], old[..., : x + a])
    np.testing.assert_allclose(new[..., x + a], old[..., x + a : x + a + n].mean(axis=-1), rtol=1e-6)
    np.testing.assert_array_equal(new[..., x + a + 1 :], old[..., x + a + n :])  # more, x', discount
    np.testing.assert_array_equal(after.env.episode_step, before.env.episode_step)
    np.testing.assert_allclose(
        np.asarray(after.env.episode_return)[..., 0], np.asarray(before.env.episode_return).mean(axis=-1), rtol=1e-6
    )
    np.testing.assert_array_equal(
        np.asarray(after.env.observation[0]), np.concatenate([np.asarray(o) for o in before.env.observation], axis=-1)
    )
    jax.tree.map(np.testing.assert_array_equal, after.statistics, before.statistics)
    np.testing.assert_array_equal(jax.random.key_data(after.key), jax.random.key_data(before.key))


def test_the_table_begins_with_the_agents_part(whole):
    mine, theirs = rows(whole), rows(whole / hybrid.FOLDER)
    assert len(mine) > len(theirs) > 4
    for row, old in zip(mine, theirs, strict=False):
        for name in ("step", "seed", "updates", "episodes", "return_agents", "eval_return_agents"):
            assert row[name] == old[name]
        for name in ("return", "critic_loss", "q_value", "eval_return"):
            mean = np.mean([float(old[f"agent_{i}_{name}"]) for i in range(3)])
            np.testing.assert_allclose(float(row[f"agents_{name}"]), mean, rtol=1e-6, equal_nan=True)
    after = mine[len(theirs) :]
    assert int(after[0]["step"]) == 690 and all(np.isfinite(float(row["agents_critic_loss"])) for row in after)
    assert int(after[0]["updates"]) == int(theirs[-1]["updates"]) + 20


def test_stopped_and_resumed_it_is_the_same_to_the_bit(whole, tmp_path, monkeypatch, capsys):
    """SIGTERM comes while the agents learn, with their last interval, and when the one agent has taken over."""
    append, stops = RunDirectory.append, [390, 590, 790]

    def append_and_signal(self, row):
        append(self, row)
        if int(row["step"][0]) in stops:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(RunDirectory, "append", append_and_signal)
    cut = tmp_path / "cut"
    given = [*SPREAD, f"out={tmp_path}", "name=cut"]
    for at in stops:
        assert train.main(given) == 128 + signal.SIGTERM
        given = [f"resume={cut}"]
        assert f"resume with: python -m matd3_jax.train resume={cut}\n" in capsys.readouterr().out
        part = cut if at > 590 else cut / hybrid.FOLDER
        assert int(rows(part)[-1]["step"]) == at == checkpoint.steps(part / "checkpoints")[-1]
    assert train.main(given) == 0
    assert_same_run(cut, whole)


def test_killed_before_its_first_checkpoint_it_takes_over_again(whole, tmp_path):
    copy = shutil.copytree(whole, tmp_path / "copy")
    shutil.rmtree(copy / "checkpoints")
    (copy / "summary.json").unlink()
    left = copy / ".run.12345.partial"  # by a kill while the agents' directory was made
    shutil.copytree(copy / hybrid.FOLDER, left)
    assert train.main([f"resume={copy}"]) == 0
    assert_same_run(copy, whole)
    assert not left.exists()


def test_it_is_evaluated_like_any_run(whole, capsys):
    assert evaluate.main([f"run={whole}", "episodes=2"]) == 0
    assert evaluate.main([f"run={whole}", "episodes=2", "checkpoint=best"]) == 0
    assert evaluate.main([f"run={whole / hybrid.FOLDER}", "episodes=2"]) == 0


def test_a_sweep_of_them_is_that_of_runs_alone(tmp_path):
    """Two teams, one of which is handed over; one batch of two learning rates, with a signal in between."""
    settings = [*TINY, "total_steps=700", "eval_every=0", "algo.policy_delay=1", f"out={tmp_path}"]
    assert sweep.main([*settings, "algo.lr=0.01,0.1", "name=swept"]) == 0
    # With as many seeds as the batch has it is the same program, which is compiled already.
    assert train.main([*settings, "algo.lr=0.1", "name=alone", "seeds=4"]) == 0
    found, alone = rows(tmp_path / "swept" / "runs" / "lr_0.1"), rows(tmp_path / "alone")
    alone = [row for row in alone if int(row["seed"]) < 2]
    assert len(found) == len(alone) and found[0].keys() == alone[0].keys()
    for a, b in zip(found, alone, strict=True):
        for name in a:
            np.testing.assert_allclose(float(a[name]), float(b[name]), rtol=2e-4, atol=1e-4, err_msg=name)
    assert {"agents_return", "adversary_0_critic_loss"} <= found[0].keys()
    assert not (tmp_path / "swept" / "batches").exists() or not list((tmp_path / "swept" / "batches").iterdir())


def test_both_teams_may_be_handed_over(tmp_path, capsys):
    """Without adversary= the opponents are a hybrid, too."""
    given = [*TINY[3:], "env=simple_adversary", "algo=hybrid", "total_steps=700", f"out={tmp_path}", "name=run"]
    assert train.main(given) == 0
    table = rows(tmp_path / "run")
    assert {"agents_return", "adversaries_critic_loss"} <= table[0].keys() and int(table[-1]["step"]) == 790
    assert all(np.isfinite(float(table[-1][f"{team}_critic_loss"])) for team in ("agents", "adversaries"))


def test_where_all_seeds_diverge_it_ends_there(tmp_path):
    """Before the switch: the one agent takes over where they stopped, and nobody is left to train."""
    given = [
        "algo.lr=1e30",
        "algo.policy_delay=1",
        "on_divergence=stop_seed",
        "eval_every=0",
        "total_steps=900",
        "env=simple_spread",
    ]
    assert train.main([*TINY[5:], "algo=hybrid", "algo.hidden=[4]", *given, f"out={tmp_path}", "name=run"]) == 3
    steps = [int(row["step"]) for row in rows(tmp_path / "run")]
    assert steps == sorted(steps) and steps[-1] < 500 and len(steps) == len(rows(tmp_path / "run" / "agents")) + 2
    last = int(checkpoint.verify(tmp_path / "run" / "checkpoints").name)
    assert last == steps[-1] and len(set(steps)) == len(steps) // 2


def test_without_a_directory():
    result = train_here("algo.hidden=[4]", "algo.policy_delay=1", algo="hybrid", seeds=1, num_envs=2, total_steps=400,
                        learning_starts=100, batch_size=16, log_every=100, eval_every=0)  # fmt: skip
    assert result.run_dir is None and result.metrics["agents_critic_loss"].shape == (1, 5)
    assert result.evaluate(episodes=2).shape == (1, 2, 1)


@pytest.mark.parametrize(
    "settings, message",
    [
        (["algo=matd3", "switch_at=300"], r"^switch_at=300 goes with algo=hybrid$"),
        (["algo=hybrid", "switch_at=100"], r"^switch_at=100: learning starts after env step 190 and ends at 690, and"),
        (["algo=hybrid", "switch_at=600"], r"^switch_at=600: learning starts after"),
        (["algo=hybrid", "algo.critic_norm=layer"], r"^algo\.critic_norm=layer: hybrid's agents hand over critics"),
    ],
)
def test_impossible_settings_are_one_line_before_anything_is_written(tmp_path, settings, message):
    small = [*TINY[5:], "total_steps=600", "env=simple_spread", f"out={tmp_path / 'runs'}"]
    for command in (train.main, sweep.main):
        with pytest.raises(UserError, match=message):
            command([*small, *settings, "name=x"])
    assert not (tmp_path / "runs").exists()
