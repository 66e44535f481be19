"""Runs that begin with networks of others (init=), and that play against their frozen teams (adversary.policy=)."""

import csv
import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest
from checkpoint_arrays import assert_same_run

from matd3_jax import config
from matd3_jax.cli import check, command, crossplay, evaluate, sweep
from matd3_jax.errors import UserError
from matd3_jax.evaluation import cross_play
from matd3_jax.training import best, checkpoint, starting
from matd3_jax.training.recording import Recorder
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

ENV = ["env=simple_adversary"]
SMALL = [
    "num_envs=4", "rollout_length=5", "batch_size=16", "learning_starts=200", "replay_capacity=400", "eval_episodes=2",
    "total_steps=600", "log_every=200", "eval_every=200", "checkpoint_every=200", "keep_checkpoints=9",
]  # fmt: skip
SOURCE = [
    *ENV, *SMALL, "seeds=2", "seed=5", "algo.hidden=[7]", "adversary=maddpg", "adversary.hidden=[6,5]",
    "adversary.actor_average=0.3", "normalize_observations=true", "normalize_least_deviation=0.2",
    "algo.policy_delay=1",
]  # fmt: skip
AGAINST = [*ENV, *SMALL, "seeds=3", "algo.hidden=[8]", "algo.policy_delay=1", "adversary.frozen=true"]


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "the source"
    Recorder().start(config.load(SOURCE), path)
    return path


def against(source, *more):
    return config.load([*AGAINST, f"adversary.policy={source}", *more])


@pytest.fixture(scope="module")
def fighting(source, tmp_path_factory):
    """A run against the source's adversaries; the source it was made from is gone."""
    folder = tmp_path_factory.mktemp("against")
    shutil.copytree(source, folder / "source")
    Recorder().start(against(folder / "source"), folder / "run")
    shutil.rmtree(folder / "source")
    return folder / "run"


@pytest.fixture
def copy(fighting, tmp_path):
    return shutil.copytree(fighting, tmp_path / "run")


def restored(path, step=None):
    training = TrainingSession(config.read(path / "config.yaml"))
    return training, checkpoint.restore_actors(checkpoint.verify(path / "checkpoints", step), training.trainer)


def table(path):
    with (path / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


# ---- frozen teams ----------------------------------------------------------------------------------------------------


def test_a_frozen_team_has_the_settings_of_its_run(fighting, source):
    there, here = config.read(source / "config.yaml").adversary, config.read(fighting / "config.yaml").adversary
    assert here.name == "maddpg" and here.hidden == (6, 5) and here.frozen and not there.frozen
    assert here.actor_average == 0.3 and here.policy.endswith("/source")


def test_where_its_policy_learned_is_said_where_it_was_elsewhere(source):
    """Also of networks that a run begins with."""
    settings = against(source, f"init={source}")
    name, length = settings.env["name"], settings.env["episode_length"]
    elsewhere = [
        (settings.env, "last checkpoint)"),
        ({**settings.env, "name": "simple_push"}, f"last checkpoint; learned in {name})"),
        ({**settings.env, "episode_length": 9}, f"last checkpoint; learned with env.episode_length={length})"),
    ]
    for env, words in elsewhere:
        found = starting.lines(dataclasses.replace(settings, env=env))
        assert len(found) == 2 and all(words in line for line in found)


def test_its_networks_are_the_evaluated_ones_of_the_run_and_never_change(fighting, source):
    """Averaged actors; seed s plays against seed s of the source, counted round: 0, 1, 2 against 6, 5, 6."""
    _, there = restored(source)
    steps = checkpoint.steps(fighting / "checkpoints")
    assert len(steps) > 2
    learners = []
    for step in steps:
        training, here = restored(fighting, step)
        g = training.layout.place(0)[0]
        assert training.layout.groups[g].frozen and here.groups[g].critic is None
        for name, leaf in here.groups[g].actor.items():
            averaged = np.asarray(there.groups[g].actor_average[name])
            np.testing.assert_array_equal(np.asarray(leaf)[:3], averaged[[1, 0, 1]], err_msg=f"{name} at {step}")
        learners.append(np.asarray(here.groups[1 - g].actor["kernel_0"]))
    assert all((a != b).any() for a, b in zip(learners, learners[1:], strict=False))


def test_its_returns_are_told_and_losses_there_are_none(fighting):
    rows = table(fighting)
    names = set(rows[0])
    assert {"return_adversaries", "adversary_0_return", "eval_return_adversaries", "agent_0_critic_loss"} <= names
    assert not {f"adversary_0_{name}" for name in ("critic_loss", "q_value", "actor_loss")} & names
    assert all(np.isfinite(float(row["agent_0_critic_loss"])) for row in rows if float(row["updates"]))
    assert json.loads((fighting / "summary.json").read_text())["diverged"] == {}


def test_it_plays_as_in_its_own_run(fighting, source):
    """With its own normalization, which the learners do not have: the same episodes as with the source's own team."""
    env = TrainingSession(config.load([*ENV, *SMALL])).env
    (mine, my_state), (other, its_state) = restored(fighting), restored(source)
    agents = cross_play.team_of(mine, env, my_state, "agents")
    frozen, own = (
        cross_play.team_of(training, env, state, "adversaries")
        for training, state in ((mine, my_state), (other, its_state))
    )
    pairs = np.array([[0, 0], [1, 1], [2, 2]])
    found = cross_play.play(env, [agents, frozen], pairs, 4, deterministic=True)
    wanted = cross_play.play(env, [agents, own], np.array([[0, 1], [1, 0], [2, 1]]), 4, deterministic=True)
    np.testing.assert_allclose(found, wanted, rtol=1e-4)
    last = mine.evaluate(my_state, 4, deterministic=True).episode_return.mean(axis=1)
    np.testing.assert_allclose(found, last, rtol=1e-4)


@pytest.mark.parametrize("left", ["nothing but its settings", "its second checkpoint"])
def test_a_killed_run_comes_to_the_same_bits_without_its_source(copy, fighting, left):
    (copy / "summary.json").unlink()
    keep = checkpoint.steps(copy / "checkpoints")[1]
    for path in list((copy / "checkpoints").iterdir()):
        if left == "nothing but its settings" or int(path.name) > keep:
            shutil.rmtree(path)
    if left == "nothing but its settings":
        (copy / "metrics.csv").unlink()
    Recorder().resume(copy)
    assert_same_run(copy, fighting)


def test_commands_play_it(fighting, tmp_path, capsys):
    assert evaluate.main([f"run={fighting}", "episodes=2", "checkpoint=best"]) == 0
    assert crossplay.main([f"runs={fighting}", "episodes=2", f"out={tmp_path / 'out'}", "checkpoint=best"]) == 0
    assert check.main([f"run={fighting}"]) == 0
    capsys.readouterr()


def test_a_start_that_is_damaged_is_named_where_it_is_needed(copy, capsys):
    data = (copy / "start.npz").read_bytes()
    (copy / "start.npz").write_bytes(data[: len(data) // 2])
    assert check.main([f"run={copy}"]) == 0  # its checkpoints have all that it needs
    shutil.rmtree(copy / "checkpoints")
    assert check.main([f"run={copy}"]) == 1
    assert "start.npz is damaged" in capsys.readouterr().out
    with pytest.raises(UserError, match="start.npz is damaged: the run cannot be started anew"):
        Recorder().resume(copy)


def test_agents_may_be_the_frozen_ones(source):
    """And the best evaluations are then judged by the adversaries' returns; policies of the best, all of one seed."""
    lines = ["adversary=matd3", "algo.frozen=true", f"algo.policy={source}", "algo.policy_checkpoint=best"]
    training = TrainingSession(config.load([*ENV, *SMALL, *lines, "algo.policy_seed=6", "seeds=2"]))
    assert training.best.weights.tolist() == [1, 0, 0] and training.layout.learners == (0,)
    given = starting.gather(training)
    kept = best.read(checkpoint.verify(source / "checkpoints"), 1)
    g = training.layout.place(1)[0]
    for name in ("kernel_0", "bias_1"):
        path = f".groups[{g}].actor['{name}']"
        for seed in range(2):
            np.testing.assert_array_equal(given[path][seed], kept.policies[path])


def test_critics_judged_beside_a_frozen_team(source):
    """Overestimation is that of the learners alone."""
    lines = ["diagnostics.q_bias=true", "diagnostics.q_bias_rollouts=4", "diagnostics.q_bias_steps=3", "seeds=1"]
    training = TrainingSession(against(source, *lines))
    state, row = training.start()
    assert np.isfinite(row["agent_1_overestimation"]).all() and "adversary_0_overestimation" not in row
    assert set(row) == set(training.columns)


def test_runs_of_a_sweep_play_against_it(source, tmp_path, capsys):
    argv = [*AGAINST, f"adversary.policy={source}", "algo.lr=0.01,0.001", f"out={tmp_path}", "name=two", "seeds=1"]
    assert sweep.main([text for text in argv if text != "seeds=3"]) == 0
    runs = sorted((tmp_path / "two" / "runs").iterdir())
    assert len(runs) == 2 and all((path / "start.npz").exists() for path in runs)
    (_, one), (training, two) = map(restored, runs)
    g = training.layout.place(0)[0]
    for a, b in zip(*(jax.tree.leaves(state.groups[g]) for state in (one, two)), strict=True):
        np.testing.assert_array_equal(a, b)
    capsys.readouterr()


# ---- init ------------------------------------------------------------------------------------------------------------


def beginning(source, *more):
    without = [text for text in SOURCE if not text.startswith("seed")]
    return TrainingSession(config.load([*without, "seeds=3", "seed=4", f"init={source}", *more]))


@pytest.mark.parametrize("more", [[], ["init_seed=6"]], ids=str)
def test_networks_are_taken_over_and_optimizers_are_fresh(source, more):
    training = beginning(source, *more)
    _, there = restored(source)
    fresh = training.trainer.init(training.keys())
    untouched = jax.tree.map(np.asarray, [group.actor_optimizer for group in fresh.groups])
    state = starting.put(training.trainer, fresh, starting.gather(training), training.share)
    rows = [1, 1, 1] if more else [1, 0, 1]  # seeds 4, 5, 6 begin with 6, 5, 6
    for here, before, optimizer in zip(state.groups, there.groups, untouched, strict=True):
        for part in ("actor", "critic", "actor_target", "critic_target", "actor_average"):
            pair = jax.tree.map(lambda a, b: (np.asarray(a)[:3], np.asarray(b)[rows]), *(
                getattr(group, part) for group in (here, before)))  # fmt: skip
            for a, b in jax.tree.leaves(pair, is_leaf=lambda node: isinstance(node, tuple)):
                np.testing.assert_array_equal(a, b, err_msg=part)
        for a, b in zip(jax.tree.leaves(here.actor_optimizer), jax.tree.leaves(optimizer), strict=True):
            np.testing.assert_array_equal(a, b)
            assert not np.asarray(a).any()


def test_statistics_are_taken_over_with_their_weight(source):
    """After the warm-up: those of all observations, the source's and its own, pooled."""
    training = beginning(source, "num_envs=2")
    _, there = restored(source)
    state, _ = training.start()
    warm, rows = training.trainer.schedule.warmup_steps, [1, 0, 1]
    old = int(there.rollouts) * 20  # env steps of the source
    x = np.asarray(training.trainer.layout.row_parts(state.replay[:3, :warm]).x, np.float64)
    mean, variance = (np.asarray(leaf, np.float64)[rows] for leaf in there.statistics)
    pooled = (old * mean + warm * x.mean(axis=1)) / (old + warm)
    square = (old * (variance + mean**2) + warm * (x**2).mean(axis=1)) / (old + warm)
    np.testing.assert_allclose(state.statistics.mean[:3], pooled, atol=1e-5)
    np.testing.assert_allclose(state.statistics.variance[:3], square - pooled**2, rtol=1e-3, atol=1e-5)


def test_of_the_best_evaluations_come_the_actors(source):
    training = beginning(source, "init_checkpoint=best")
    given, (_, there) = starting.gather(training), restored(source)
    kept = best.read(checkpoint.verify(source / "checkpoints"), 0)  # seed 5
    for g, group in enumerate(there.groups):
        for name, leaf in group.critic.items():
            np.testing.assert_array_equal(given[f".groups[{g}].critic['{name}']"][1], np.asarray(leaf)[0])
        for part in ("actor", "actor_target"):
            for name in group.actor:
                path = f".groups[{g}].{{}}['{name}']"
                np.testing.assert_array_equal(given[path.format(part)][1], kept.policies[path.format("actor")])


def test_a_run_goes_on_from_where_the_other_was(source, tmp_path):
    """Its first row is what the source's policies get; killed before its first checkpoint it begins with them again."""
    settings = beginning(source).config
    Recorder().start(settings, tmp_path / "run")
    shutil.copytree(tmp_path / "run", tmp_path / "killed")
    first = [row for row in table(tmp_path / "run") if row["step"] == table(tmp_path / "run")[0]["step"]]
    fine = TrainingSession(settings)
    state = starting.put(fine.trainer, fine.trainer.init(fine.keys()), starting.gather(fine), fine.share)
    state, _ = fine.trainer.warm_up(state)
    wanted = fine.evaluate(state, 2, deterministic=True).episode_return[..., 0].mean(axis=1)
    np.testing.assert_allclose([float(row["adversary_0_eval_return"]) for row in first], wanted, rtol=1e-5)
    shutil.rmtree(tmp_path / "killed" / "checkpoints")
    for name in ("metrics.csv", "summary.json"):
        (tmp_path / "killed" / name).unlink()
    Recorder().resume(tmp_path / "killed")
    assert_same_run(tmp_path / "killed", tmp_path / "run")


# ---- what does not fit -----------------------------------------------------------------------------------------------

N = ["normalize_observations=true", "normalize_least_deviation=0.2"]
SAME = [*N, "algo.hidden=[7]", "adversary=maddpg", "adversary.hidden=[6,5]"]
BAD = {
    "init=nowhere": "init=nowhere: there is no run directory nowhere",
    "init=SOURCE": "init=SOURCE: its networks were trained with normalize_observations=true; normalize_obs",
    "init=SOURCE init_checkpoint=7 " + " ".join(N): "holds no checkpoint of step 7",
    "init=SOURCE init_seed=4 " + " ".join(SAME): "init_seed=4: the seeds of SOURCE are 5 to 6",
    "init=SOURCE " + " ".join([*SAME[:2], *SAME[3:]]):
        "init=SOURCE: the actor of agent_0 does not fit: bias_0 is [7] there, [64] here",
    "init=SOURCE algo.num_critics=1 " + " ".join(SAME):
        "init=SOURCE: the critic of agent_0 does not fit: bias_0 is [2, 7] there, [1, 7] here",
    "init=SOURCE env=simple_speaker_listener " + " ".join(N):
        "init=SOURCE: there is no speaker_0 there, but adversary_0, agent_0, agent_1",
    "init=SOURCE env.num_good=3 " + " ".join(SAME):
        "init=SOURCE: the actor of adversary_0 does not fit: its layer 0 reads 8 numbers there, ",
    "init=SOURCE env.actions=discrete " + " ".join(SAME): "acts in Simplex(sizes=(5,)) there, in Discrete(n=5) here",
    "init_seed=3": "init_checkpoint= and init_seed= go with init=RUN_DIR",
    "init=SOURCE init_checkpoint=newest": "init_checkpoint=newest: must be the env step of a checkpoint",
    "init=": "init=: must name a run directory",
    "adversary.frozen=true": "adversary.frozen=true: say whose policy the team plays, with adversary.policy=RUN_DIR",
    "adversary.policy=SOURCE": "adversary.policy=SOURCE goes with adversary.frozen=true",
    "adversary.policy_seed=3": "adversary.policy_checkpoint= and adversary.policy_seed= go with adversary.frozen=true",
    "algo.frozen=true algo.policy=SOURCE": "algo.frozen=true: nobody would learn",
    "adversary.frozen=true adversary.policy=nowhere": "adversary.policy=nowhere is no run directory: there is no such",
    "adversary.frozen=true adversary.policy=SOURCE adversary.lr=0.1": "adversary.lr=0.1: a frozen team has the",
    "adversary.frozen=true adversary.policy=SOURCE adversary=matd3": "adversary=matd3: a frozen team has the settings",
    "adversary.frozen=true adversary.policy=SOURCE env=simple_tag": "reads 8 numbers there, 16",
    "adversary.frozen=true adversary.policy=SOURCE adversary.policy_seed=9": "adversary.policy_seed=9: the seeds of",
    "adversary.frozen=true adversary.policy=SOURCE adversary.policy_checkpoint=x": "policy_checkpoint=x: must be",
    "adversary.frozen=true adversary.policy=SOURCE env=simple_spread": "has no adversaries",
}  # fmt: skip


@pytest.mark.parametrize("words", BAD)
def test_what_does_not_fit_is_one_line_and_nothing_is_written(words, source, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "SOURCE").symlink_to(source)
    env = [] if "env=" in words else ENV
    assert command.code(lambda argv: command.start("train", argv), [*env, *SMALL, "name=new", *words.split()]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and BAD[words] in said, said
    assert [path.name for path in tmp_path.iterdir()] == ["SOURCE"]


def test_a_seed_that_diverged_is_not_begun_with(source, tmp_path):
    path = shutil.copytree(source, tmp_path / "run")
    training, _ = restored(path)
    last = checkpoint.verify(path / "checkpoints")
    state = checkpoint.restore(last, training.trainer)
    actor = {name: np.array(leaf) for name, leaf in state.groups[0].actor.items()}
    actor["bias_0"][0] = np.nan
    broken = state._replace(groups=(state.groups[0]._replace(actor=actor), *state.groups[1:]))
    checkpoint.save(path / "checkpoints", int(last.name), training.trainer, broken, 9)
    with pytest.raises(UserError, match="seed 5 diverged there; choose another with init_seed="):
        starting.gather(beginning(path))
    starting.gather(beginning(path, "init_seed=6"))
