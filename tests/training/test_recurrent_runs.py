"""Runs of recurrent networks: what is stored and played, resumed, swept, begun with, played against, and refused."""

import csv

import jax
import numpy as np
import pytest
import reference
from checkpoint_arrays import assert_resumes_to_the_bit
from cross_cases import OWN, SEED
from gru_reference import one_step
from learner_cases import layers

from matd3_jax import config, envs
from matd3_jax.cli import evaluate, export, sweep, train
from matd3_jax.core import acting
from matd3_jax.errors import UserError
from matd3_jax.evaluation import cross_play, trajectory
from matd3_jax.training import checkpoint, starting
from matd3_jax.training.loop import TrainLoop
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

GRU = ["algo.actor=gru", "algo.gru_units=5", "sequence_length=4", "burn_in=2"]
TINY = [
    "env=simple_adversary", "env.episode_length=7", *GRU, "adversary=maddpg", "algo.hidden=[6]", "adversary.hidden=[5]",
    "batch_size=16", "num_envs=2", "rollout_length=5", "learning_starts=100", "replay_capacity=300", "log_every=100",
    "normalize_observations=true", "seeds=2", "eval_every=200", "eval_episodes=2", "total_steps=500",
    "algo.policy_delay=1",
]  # fmt: skip

ENV7 = envs.make("simple_adversary", episode_length=7)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A finished run: two recurrent agents, whose actors are delayed, against one without memory."""
    out = tmp_path_factory.mktemp("runs")
    more = ["algo.policy_delay=2", "algo.actor_average=0.2", "checkpoint_every=100", "keep_checkpoints=9"]
    assert train.main([*config.merge(TINY, more), f"out={out}", "name=whole"]) == 0
    return out / "whole"


@pytest.fixture(scope="module")
def restored(whole):
    training = TrainingSession(config.read(whole / "config.yaml"))
    return training, checkpoint.restore(checkpoint.verify(whole / "checkpoints"), training.trainer)


def test_resumed_to_the_bit(whole, tmp_path):
    assert_resumes_to_the_bit(whole, tmp_path / "copy")
    with (whole / "metrics.csv").open(newline="") as file:
        last = list(csv.DictReader(file))[-1]
    assert all(np.isfinite(float(last[f"agent_{i}_critic_loss"])) for i in range(2))


def test_states_follow_from_what_was_seen_and_done():
    """Every stored state is the sum of its episode so far, 0 where one begins, and actions are chosen by it."""
    training = TrainingSession(config.load([*TINY, "normalize_observations=false"]))
    trainer, layout = training.trainer, training.layout
    state = trainer.init(training.keys())
    for _ in range(4):
        state, _ = trainer.rollout(state, trainer.hyper)
    rows = layout.row_parts(np.asarray(state.replay)[1, :40].reshape(20, 2, -1))
    g, _ = layout.place(1)
    ends = 0
    for member, agent in enumerate((1, 2)):
        actor = jax.tree.map(lambda leaf, k=member: np.asarray(leaf, np.float64)[1, k], state.groups[g].actor)
        seen, done = layout.observation_part(rows.x, agent), layout.action_part(rows.action, agent)
        h = np.zeros((2, 5))
        for t in range(20):
            np.testing.assert_allclose(layout.state_part(rows.state, agent)[t], h, rtol=1e-4, atol=1e-6)
            h = one_step(actor["gru"], h, np.concatenate([seen[t], done[t]], axis=-1))
            h, ends = h * rows.more[t, :, None], ends + (rows.more[t] == 0).sum()
    assert ends == 2 * 2 * (20 // 7)
    policy = jax.tree.map(lambda leaf: leaf[1], trainer.policy(state))
    x, h = (jax.random.normal(jax.random.key(k), (3, size)) for k, size in ((0, layout.observation_size), (1, 10)))
    observation = [layout.observation_part(x, i) for i in range(3)]
    actions, _ = acting.decide(layout, policy, observation, None, h)
    params = layers(state.groups[g].actor, 1, 1)
    logits, _ = reference.forward(params, np.concatenate([observation[2], h[:, 5:]], axis=-1).astype(float))
    want = np.exp(logits) / np.exp(logits).sum(axis=-1, keepdims=True)
    np.testing.assert_allclose(actions[2], want, rtol=1e-4, atol=1e-6)


def test_one_episode_is_that_of_evaluations_and_encounters(restored):
    """States go on from step to step wherever policies are played."""
    training, state = restored
    found = np.asarray(training.evaluate(state, 3, True, SEED).episode_return)
    teams = [cross_play.team_of(training, ENV7, state, team) for team in cross_play.TEAMS]
    played = cross_play.play(ENV7, teams, OWN[:2], 3, True, SEED)
    np.testing.assert_allclose(played, found.mean(axis=1), rtol=1e-5, atol=1e-5)
    default = np.asarray(training.evaluate(state, 3, True).episode_return)
    episode = trajectory.play(training, state, seed=1, number=2)
    assert episode.returns["adversaries"][-1] == pytest.approx(default[1, 2, 0], rel=1e-5)


def test_evaluated_and_swept_like_any_run(whole, tmp_path):
    assert evaluate.main([f"run={whole}", "episodes=2", "checkpoint=best"]) == 0
    assert sweep.main([*TINY, "eval_every=0", "algo.lr=0.01,0.1", f"out={tmp_path}", "name=swept"]) == 0
    # With as many seeds as the batch has it is the same program, which is compiled already.
    alone = config.merge(TINY, ["eval_every=0", "algo.lr=0.1", "seeds=4"])
    assert train.main([*alone, f"out={tmp_path}", "name=alone"]) == 0
    tables = []
    for path in (tmp_path / "swept" / "runs" / "lr_0.1", tmp_path / "alone"):
        with (path / "metrics.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if int(row["seed"]) < 2]
            tables.append([[float(v or "nan") for v in row.values()] for row in rows])
    assert len(tables[0]) > 6
    np.testing.assert_allclose(*tables, rtol=2e-4, atol=1e-4)


def test_begun_with(whole):
    """Another run begins with all its networks, states' units among them."""
    given = starting.gather(TrainingSession(config.load([*TINY, "algo.actor_average=0.2", f"init={whole}"])))
    names = [name for name in given if "gru" in name and "actor" in name]
    assert len(names) == 3 * 4  # actor, target and average of the one recurrent group
    with pytest.raises(UserError, match=r"^init=.*: the actor of agent_0 does not fit: .*kernel_0 is "):
        starting.gather(TrainingSession(config.load([*TINY, "algo.actor=mlp", f"init={whole}"])))


def test_devices_share_whole_sequences():
    """A minibatch that two devices share gives the same networks as one device's, to rounding."""
    session = TrainingSession(config.load([*TINY, "seeds=1", "normalize_observations=false"]))
    found = []
    for count in (1, 2):
        t = session.trainer
        hyper = {team: algo.hyper_params() for team, algo in session.config.teams().items()}
        devices = jax.devices()[:count]
        loop = TrainLoop(t.env, t.layout, t.schedule, hyper, 1, devices, devices_per_seed=count)
        state, _ = loop.warm_up(loop.init(session.keys()))
        state, _ = loop.interval(4)(state)
        found.append(jax.tree.map(np.asarray, state.groups))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4), *found)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["n_step=3"], r"^algo\.actor=gru has targets of one step: give n_step=1$"),
        (["algo.share_parameters=kind"], r"^algo\.actor=gru has networks for each agent: leave algo\.share_parameters"),
        (["algo.critic=shared"], r"^algo\.actor=gru has critics for each agent: leave algo\.critic=shared out$"),
        (["algo=m3ddpg"], r"^algo\.actor=gru: algo\.adversarial_step moves actions"),
        (["algo=hybrid"], r"^algo\.actor=gru: hybrid's agents hand over networks with algo\.actor=mlp alone$"),
        (["update_order=random_sequential"], r"^algo\.actor=gru learns from replayed actions"),
        (["diagnostics.q_bias=true"], r"^diagnostics\.q_bias=true begins anywhere in an episode"),
        (["batch_size=18"], r"^batch_size=18 is not a multiple of sequence_length=4$"),
        (["learning_starts=11"], r"^learning_starts=11 is less than a sequence in each environment: .* = 12$"),
        (["algo.actor=lstm"], r"^algo\.actor='lstm': must be one of mlp, gru"),
        (["algo.gru_units=0"], r"^algo\.gru_units=0: must"),
    ],
    ids=str,
)  # fmt: skip
def test_impossible_settings_are_one_line_before_anything_is_written(tmp_path, more, said):
    line = [text for text in TINY if not text.startswith(tuple(f"{m.split('=')[0]}=" for m in more))]
    with pytest.raises(UserError, match=said):
        train.main([*line, *more, f"out={tmp_path / 'runs'}", "name=x"])
    assert not (tmp_path / "runs").exists()


def test_what_plays_without_states_is_refused(whole, tmp_path):
    with pytest.raises(UserError, match=r"^export writes policies of one observation"):
        export.main([f"run={whole}", "format=numpy", f"out={tmp_path / 'policy'}"])
    frozen = ["adversary=matd3", "algo.frozen=true", f"algo.policy={whole}"]
    with pytest.raises(UserError, match=r"its actors are recurrent, and frozen teams play others alone$"):
        config.load([*(text for text in TINY if not text.startswith(("algo", "adversary", "seq", "burn"))), *frozen])
    joint = ["algo=td3", "algo.hidden=[12]", f"init={whole}"]
    rest = [text for text in TINY if not text.startswith(("algo", "seq", "burn"))]
    with pytest.raises(UserError, match=r"agent_0 has actor=gru there, agents actor=mlp here$"):
        starting.gather(TrainingSession(config.load([*rest, *joint])))
    assert not (tmp_path / "policy").exists()
