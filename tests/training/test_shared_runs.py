"""Runs whose agents share networks: resumed, swept, begun with, played against, exported, and what is refused."""

import csv

import jax
import numpy as np
import pytest
import reference
from checkpoint_arrays import assert_resumes_to_the_bit
from cross_cases import OWN, SEED, SMALL, make, meet, runs
from learner_cases import layers

from matd3_jax import config
from matd3_jax.cli import command, sweep, train
from matd3_jax.core import q_bias
from matd3_jax.errors import UserError
from matd3_jax.evaluation import cross_play
from matd3_jax.runs.directory import RunDirectory
from matd3_jax.sweep import batching
from matd3_jax.sweep.runner import Sweep
from matd3_jax.training import best, checkpoint, memory, saved_policies, starting
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.recording import Recorder
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

TINY = [
    "env=simple_adversary", "seeds=2", "algo.hidden=[8]", "batch_size=16", "num_envs=2", "learning_starts=200",
    "replay_capacity=500", "total_steps=600", "log_every=100", "eval_every=300", "eval_episodes=2",
    "algo.policy_delay=1",
]  # fmt: skip
KIND, TEAM = "algo.share_parameters=kind", "algo.critic=shared"
MODES = {"kind": [KIND], "team": [TEAM]}


@pytest.fixture(scope="module", params=MODES)
def trained(request, tmp_path_factory):
    """(its mode, run directory)."""
    folder = tmp_path_factory.mktemp("shared")
    line = [*TINY, *MODES[request.param], f"out={folder}", "name=whole", "checkpoint_every=300", "keep_checkpoints=3"]
    more = ["algo.actor_average=0.2", "diagnostics.q_bias=true", "diagnostics.q_bias_steps=3"]
    assert train.main([*line, *more]) == 0
    return request.param, folder / "whole"


def restored(path):
    training = TrainingSession(config.read(path / "config.yaml"))
    return training, checkpoint.restore_actors(checkpoint.verify(path / "checkpoints"), training.trainer)


def one_network(group, k, agents, seed, *critic):
    """Layers of agent k's network out of one that several share, written anew: its index's row added to the bias."""
    (kernel, bias), *rest = layers(group, seed, 0, *critic)
    inputs = len(kernel) - agents
    return [(kernel[:inputs], bias + kernel[inputs + k]), *rest]


def test_resumed_to_the_bit(trained, tmp_path):
    """Metrics, Q-bias among them, and every number of the last checkpoint."""
    _, whole = trained
    assert_resumes_to_the_bit(whole, tmp_path / "cut")


def test_what_its_metrics_say(trained):
    """Of each agent, finite; of a team with one set of critics the same for all its agents."""
    mode, path = trained
    with (path / "metrics.csv").open(newline="") as file:
        last = list(csv.DictReader(file))[-1]
    for quantity in ("critic_loss", "q_value", "actor_loss", "overestimation"):
        one, two = (float(last[f"agent_{i}_{quantity}"]) for i in range(2))
        assert np.isfinite([one, two]).all()
        alike = mode != "kind" and quantity != "actor_loss"
        assert (one == two) == alike, quantity


def test_critics_that_are_shared_are_judged(trained):
    """Estimates: with the agent's index, or the team's; of the team they are compared with its mean return."""
    mode, path = trained
    training, state = restored(path)
    layout = training.layout
    inputs = np.random.default_rng(0).normal(size=(5, layout.observation_size + layout.action_size)).astype(np.float32)
    policy = jax.tree.map(lambda leaf: leaf[0], training.trainer.policy(state))
    own = [jax.tree.map(lambda leaf: leaf[0], group.critic) for group in state.groups]
    found = np.asarray(q_bias.estimate(layout, policy, own, inputs))
    g, _ = layout.place(1)
    for k, i in enumerate((1, 2)):
        nets = [layers(state.groups[g].critic, 0, 0, c) for c in range(2)]
        if mode == "kind":
            nets = [one_network(state.groups[g].critic, k, 2, 0, c) for c in range(2)]
        want = np.mean([reference.forward(net, inputs.astype(float))[0][:, 0] for net in nets], axis=0)
        np.testing.assert_allclose(found[:, i], want, rtol=1e-4, atol=1e-5)


def test_fewer_numbers_are_kept_and_counted(trained):
    """The state of the agents' team, and what the memory is expected to be."""
    mode, path = trained
    training, state = restored(path)
    plain = TrainingSession(config.load(TINY))
    g, _ = training.layout.place(1)
    small, large = (memory.size(one.groups[g]) for one in (state, plain.trainer.abstract_state()))
    assert small < 0.75 * large
    parts = [memory.parts(one.trainer, 2)["networks"].size for one in (training, plain)]
    assert parts[0] < parts[1]


# ---- other runs ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def apart(tmp_path_factory):
    """A run whose agents share nothing."""
    path = tmp_path_factory.mktemp("apart") / "run"
    Recorder().start(config.load([*TINY, "seeds=1", "total_steps=200", "eval_every=0"]), path)
    return path


def beginning(path, *more):
    lines = [text for text in TINY if not text.startswith("seed")]
    return TrainingSession(config.load([*lines, "seeds=1", f"init={path}", *more]))


def test_a_run_begins_with_it_as_it_is(trained):
    mode, path = trained
    training = beginning(path, *MODES[mode])
    given, (_, there) = starting.gather(training), restored(path)
    for g, group in enumerate(there.groups):
        for part in ("actor", "critic", "actor_target", "critic_target"):
            for name, leaf in (getattr(group, part) or {}).items():
                np.testing.assert_array_equal(given[f".groups[{g}].{part}['{name}']"], np.asarray(leaf)[:1])


def test_agents_begin_apart_with_what_they_shared(trained):
    """Each with its own copy, its index in the bias; critics of a team become each agent's."""
    mode, path = trained
    training = beginning(path)
    state = starting.put(training.trainer, training.trainer.init(training.keys()), starting.gather(training),
                         training.share)  # fmt: skip
    _, there = restored(path)
    g, _ = training.layout.place(1)
    for k in range(2):
        if mode != "team":
            got, want = layers(state.groups[g].actor, 0, k), one_network(there.groups[g].actor, k, 2, 0)
            for a, b in zip(got, want, strict=True):
                np.testing.assert_allclose(a[0], b[0], rtol=1e-6)
                np.testing.assert_allclose(a[1], b[1], rtol=1e-5, atol=1e-7)
        got = layers(state.groups[g].critic, 0, k, 1)
        want = layers(there.groups[g].critic, 0, 0, 1)
        if mode == "kind":
            want = one_network(there.groups[g].critic, k, 2, 0, 1)
        for a, b in zip(got, want, strict=True):
            np.testing.assert_allclose(a[1], b[1], rtol=1e-5, atol=1e-7)
            assert a[0].shape == b[0].shape


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ([KIND], "init=RUN: agent_0, agent_1 have one network together here, and not there"),
        ([TEAM], "init=RUN: the team of adversary_0 has one set of critics here, and not there"),
    ],
    ids=str,
)
def test_what_was_apart_is_not_begun_with_together(more, said, apart):
    with pytest.raises(UserError, match=said.replace("RUN", str(apart))):
        starting.gather(beginning(apart, *more))


def test_a_frozen_team_plays_what_it_shared(trained):
    """As plain networks of its own, to rounding as in its run."""
    mode, path = trained
    lines = [text for text in TINY if not text.startswith(("seeds", "algo"))]
    against = ["seeds=2", "algo.frozen=true", f"algo.policy={path}", "adversary=maddpg"]
    training = TrainingSession(config.load([*lines, *against]))
    state = starting.put(training.trainer, training.trainer.init(training.keys()), starting.gather(training),
                         training.share)  # fmt: skip
    other, there = restored(path)
    env = training.env
    mine = [cross_play.team_of(training, env, state, team) for team in cross_play.TEAMS]
    its = cross_play.team_of(other, env, there, "agents")
    found, wanted = (cross_play.play(env, [team, mine[1]], OWN[:2], 3, deterministic=True) for team in (mine[0], its))
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)
    g, _ = training.layout.place(1)
    assert not training.layout.groups[g].shared and state.groups[g].actor["kernel_0"].shape[1] == 2


SHARED = {
    "kind": make([*SMALL, "seeds=2", "algo=matd3", KIND, "normalize_observations=true"], number=7),
    "team": make([*SMALL, "seeds=2", "algo=matd3", TEAM], number=8),
}


@pytest.mark.parametrize("name", SHARED)
def test_own_pairs_are_evaluations(name):
    training, state = SHARED[name]
    played = meet(SHARED, name, name, OWN[:2], episodes=6)
    found = training.evaluate(state, 6, True, SEED).episode_return.mean(axis=1)
    np.testing.assert_allclose(played, found, rtol=1e-5, atol=1e-5)


def test_they_meet_runs_that_share_nothing():
    """One program for both: acting knows of no sharing."""
    both = {**SHARED, "plain": runs()["plain"]}
    sides = {both[name].team("agents").side for name in both if name != "kind"}
    assert len(sides) == 1
    found = [meet(both, one, "plain", OWN[:2]) for one in ("kind", "team", "plain")]
    assert all(np.isfinite(one).all() for one in found)
    assert np.abs(found[0] - found[2]).max() > 1e-3


# ---- sweeps and settings ---------------------------------------------------------------------------------------------


SHORT = [*(text for text in TINY if not text.startswith(("total_steps", "eval"))), "total_steps=300", "eval_every=0"]


def test_each_way_is_a_program_of_its_own():
    plain, kind, team = (batching.program(config.load([*TINY, *more])) for more in ([], [KIND], [TEAM]))
    assert plain != kind and plain != team and kind != team


def test_a_sweep_over_it_is_two_programs(tmp_path):
    assert sweep.main([*SHORT, "algo.share_parameters=none,kind", f"out={tmp_path}", "name=two"]) == 0
    assert [len(batch) for batch in Sweep(tmp_path / "two").batches] == [1, 1]


BAD = {
    f"{KIND} update_order=sequential": "algo.share_parameters=kind has one network for several agents, and no order",
    f"{KIND} update_order=random_sequential": "algo.share_parameters=kind has one network for several agents",
    f"{TEAM} update_order=sequential": "algo.critic=shared has one target for the whole team",
    f"algo=m3ddpg {TEAM}": "needs algo.critic=central: m3ddpg's critics are the whole team's",
    "algo.share_parameters=all": "algo.share_parameters='all': must be one of none, kind",
    "algo.critic=team": "algo.critic='team': must be one of central, own, shared",
    f"adversary=maddpg adversary.share_parameters=kind {TEAM} update_order=sequential": "share",
}


@pytest.mark.parametrize("words", BAD)
def test_what_cannot_be_is_one_line(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert command.code(lambda argv: command.start("train", argv), [*TINY, *words.split()]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and BAD[words] in said, said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "more",
    [
        [TEAM, "update_order=random_sequential", "n_step=3", "algo.exploration_noise=[0.1,0.3]"],
        [KIND, "algo=m3matd3", "algo.critic_head=quantile", "algo.num_critics=3", "algo.target_critics=2",
         "algo.actor_critics=all", "normalize_observations=true"],
        [KIND, TEAM, "algo.critic_norm=layer", "algo.num_critics=3", "algo.target_critics=2", "shared_minibatch=true",
         "on_divergence=stop_seed"],
        [KIND, "algo=td3", "adversary=iltd3", "adversary.share_parameters=kind"],
    ],
    ids=" ".join,
)  # fmt: skip
def test_it_goes_with_other_settings(more):
    """Everything learns and stays finite."""
    training = TrainingSession(config.load([*SHORT, *more]))
    state, _ = training.start()
    before = [np.array(group.actor["kernel_0"]) for group in state.groups]
    state, row = training.advance(state)
    assert all((a != np.asarray(group.actor["kernel_0"])).any() for a, group in zip(before, state.groups, strict=True))
    assert training.finite(state).all() and set(row) == set(training.columns)


@pytest.mark.parametrize("more", [[KIND], [TEAM, KIND]], ids=" ".join)
def test_two_devices_learn_from_a_minibatch_what_one_does(more):
    """One seed: each device has half of the minibatch, and gradients are averaged."""
    two = ["algo.policy_delay=2", "updates_per_collect=2"]  # the second sees the critics of the first
    training = TrainingSession(config.load([*SHORT, *more, *two, "seeds=1"]))
    assert training.trainer.sharding.minibatch_axis is not None
    alone = TrainLoop(training.env, training.layout, training.trainer.schedule,
                      {team: algo.hyper_params() for team, algo in training.config.teams().items()}, 1,
                      jax.local_devices()[:1])  # fmt: skip
    found = []
    for trainer in (training.trainer, alone):
        state, _ = trainer.warm_up(trainer.init(training.keys()))
        state, metrics = trainer.interval(1)(state)
        found.append(jax.tree.map(np.asarray, ([g.actor for g in state.groups], metrics.update)))
    # Adam's first step goes by the sign of a gradient: what is 0 but for rounding may go either way.
    far = [np.abs(a - b) > 1e-3 for a, b in zip(*map(jax.tree.leaves, found), strict=True)]
    assert np.mean(np.concatenate([part.ravel() for part in far])) < 0.01


def test_a_team_of_several_kinds_with_one_set_of_critics(tmp_path):
    """The second kind's group has no critics, but a best policy and a place in what other runs begin with."""
    lines = ["env=simple_speaker_listener", *TINY[1:], TEAM]
    assert train.main([*lines, f"out={tmp_path}", "name=run", "checkpoint_every=300", "keep_checkpoints=3"]) == 0
    path = tmp_path / "run"
    kept = best.read(checkpoint.verify(path / "checkpoints"), 0).policies
    assert {name.split(".actor")[0] for name in kept} == {".groups[0]", ".groups[1]"}
    training = TrainingSession(config.load([*lines, f"init={path}", "init_checkpoint=best"]))
    given, (_, there) = starting.gather(training), restored(path)
    assert [group.critic is None for group in there.groups] == [False, True]
    np.testing.assert_array_equal(
        given[".groups[0].critic['kernel_0']"], np.asarray(there.groups[0].critic["kernel_0"])
    )
    for g in range(2):
        np.testing.assert_array_equal(given[f".groups[{g}].actor['bias_1']"][0], kept[f".groups[{g}].actor['bias_1']"])
    assert not any(name.startswith(".groups[1].critic") for name in given)
    saved = saved_policies.load(RunDirectory.open(path)[0], restored(path)[0], "best")
    assert all(np.isfinite(leaf).all() for group in saved.state.groups for leaf in group.actor.values())
    assert_resumes_to_the_bit(path, tmp_path / "cut")
