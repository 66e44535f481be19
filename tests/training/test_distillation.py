"""One agent that learns by supervision what several did: checked against float64 computations with their networks."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest
from checkpoint_arrays import assert_same_run
from scipy.special import log_softmax, softmax

from matd3_jax import config
from matd3_jax.cli import train
from matd3_jax.core import replay
from matd3_jax.core.running_statistics import CLIP, LEAST_VARIANCE
from matd3_jax.errors import UserError
from matd3_jax.training import checkpoint, distillation, hybrid
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

SPREAD = [
    "env=simple_spread", "algo=hybrid", "algo.hidden=[16,12]", "algo.policy_delay=1", "algo.actor_average=0.1",
    "batch_size=32", "num_envs=2", "rollout_length=5", "learning_starts=200", "replay_capacity=900", "log_every=100",
    "eval_every=0", "normalize_observations=true", "n_step=3", "total_steps=700", "switch_at=540",
    "algo.handover=distill", "algo.distillation_updates=1500",
]  # fmt: skip
SWITCH, UPDATES = 550, 1500


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A finished run of two seeds: three agents to env step 550, then one."""
    out = tmp_path_factory.mktemp("runs")
    assert train.main([*SPREAD, "seeds=2", f"out={out}", "name=whole"]) == 0
    return out / "whole"


def taken_over(path, **settings):
    """(session, state, lines) of the one agent at the switch, and (session, state) of the agents; settings: of the
    algorithm, instead of the run's."""
    found = config.read(path / "config.yaml")
    one = TrainingSession(dataclasses.replace(found, algo=dataclasses.replace(found.algo, **settings)))
    agents = TrainingSession(config.read(path / hybrid.FOLDER / "config.yaml"))
    saved, lines = checkpoint.verify(path / hybrid.FOLDER / "checkpoints"), []
    state = hybrid.begin(one, agents, saved, lines.append)
    return (one, state, lines), (agents, checkpoint.restore(saved, agents.trainer))


def perceptron(params, x):
    """Outputs [..., batch, k] in float64."""
    layers = len(params) // 2
    for layer in range(layers):
        x = x @ np.float64(params[f"kernel_{layer}"]) + np.float64(params[f"bias_{layer}"])[..., None, :]
        x = np.maximum(x, 0) if layer < layers - 1 else x
    return x


def member(params, seed, k):
    return {name: np.asarray(leaf)[seed, k] for name, leaf in params.items()}


def choices(function, logits):
    """A function of each agent's five logits."""
    return np.concatenate([function(logits[:, k : k + 5], axis=-1) for k in (0, 5, 10)], axis=-1)


class Lesson:
    """What one agent learns of a seed in its first update, by the networks of each of the agents, in float64."""

    def __init__(self, replayed, agents, seed, key, updates=UPDATES):
        keys = jax.random.split(jax.random.fold_in(key, distillation.APART), updates)
        index_key, action_key = jax.random.split(keys[0])
        rows = np.asarray(replayed)[seed, np.asarray(replay.sample_indices(index_key, SWITCH, (32,)))]
        mean, variance = (np.float64(leaf[seed]) for leaf in agents.statistics)
        self.x = np.clip((rows[:, :54] - mean) / np.sqrt(variance + LEAST_VARIANCE), -CLIP, CLIP)
        actor, critic = agents.groups[0].actor, agents.groups[0].critic
        each = [perceptron(member(actor, seed, i), self.x[:, 18 * i : 18 * i + 18]) for i in range(3)]
        self.logits = np.concatenate(each, axis=-1)
        noise = np.float64(jax.random.gumbel(action_key, (32 * 15,))).reshape(32, 15)
        actions = rows[:, 54:69], choices(softmax, self.logits + noise)
        self.inputs = np.concatenate([np.concatenate([self.x, action], axis=-1) for action in actions])
        self.values = np.mean([perceptron(member(critic, seed, i), self.inputs)[..., 0] for i in range(3)], axis=0)

    def actor_loss(self, params):
        difference = choices(log_softmax, self.logits) - choices(log_softmax, perceptron(params, self.x))
        return (choices(softmax, self.logits) * difference).sum(axis=-1).mean()

    def critic_loss(self, params):
        return np.square(perceptron(params, self.inputs)[..., 0] - self.values).mean(axis=-1).sum()


def test_an_update_is_that_of_float64(whole):
    """Both losses, and Adam's first step: the learning rate against the sign of each slope."""
    joined = taken_over(whole, handover="join")[0]
    teacher = distillation.Teacher(joined[0].layout.groups[0], joined[1].groups[0].actor, joined[1].groups[0].critic)
    (one, after, _), (_, before) = taken_over(whole)
    untaught = after._replace(groups=one.trainer.init(one.keys()).groups)
    fresh = untaught.groups[0]
    found, fit = distillation.distill(one.trainer, untaught, 0, teacher, UPDATES)
    assert_same_tree(found.groups, after.groups)
    first, _ = distillation.distill(one.trainer, untaught, 0, teacher, 1)
    rng = np.random.default_rng(0)
    for seed in range(2):
        lesson = Lesson(after.replay, before, seed, after.key[seed])
        critic = member(fresh.critic, seed, 0)
        for name, number in (
            ("actor_loss", lesson.actor_loss(member(fresh.actor, seed, 0))),
            ("critic_loss", lesson.critic_loss(critic) / 2),
            ("variance", lesson.values.var()),
        ):
            np.testing.assert_allclose(getattr(fit, name)[seed, 0], number, rtol=1e-3, err_msg=name)
        # Of one update alone the minibatch is another.
        lesson = Lesson(after.replay, before, seed, after.key[seed], updates=1)
        for part, loss in (("actor", lesson.actor_loss), ("critic", lesson.critic_loss)):
            old, new = (member(getattr(group, part), seed, 0) for group in (fresh, first.groups[0]))
            checked = 0
            for name, leaf in old.items():
                for _ in range(6):
                    place = tuple(rng.integers(0, size) for size in leaf.shape)
                    moved = {key: np.float64(value) for key, value in old.items()}
                    sides = []
                    for step in (1e-5, -1e-5):
                        moved[name][place] = leaf[place] + step
                        sides.append(loss(moved))
                    slope = (sides[0] - sides[1]) / 2e-5
                    if abs(slope) > 1e-4:  # float32 has the sign of smaller ones by chance
                        step = float(new[name][place]) - float(leaf[place])
                        np.testing.assert_allclose(step, -0.01 * np.sign(slope), rtol=2e-2)
                        checked += 1
            assert checked > 10


def test_the_agents_are_met(whole):
    """On rows that are drawn anew: probabilities to some hundredths, values to a few percent of their variance."""
    (_, after, lines), (_, before) = taken_over(whole)
    group = after.groups[0]
    assert [leaf.shape[2] for leaf in (group.actor["bias_0"], group.actor["bias_1"])] == [16, 12]
    for seed in range(2):
        lesson = Lesson(after.replay, before, seed, jax.random.key(9))
        given = perceptron(member(group.actor, seed, 0), lesson.x)
        assert np.abs(choices(softmax, given) - choices(softmax, lesson.logits)).mean() < 0.03
        assert lesson.critic_loss(member(group.critic, seed, 0)) / 2 < 0.05 * lesson.values.var()
    assert len(lines) == 1 and lines[0].startswith(
        "agents: fitted to what the agents did in 1,500 updates; actor loss 0.0"
    )
    assert 95 < float(lines[0].split("values explain ")[1].split(" %")[0]) <= 100


def test_targets_are_copies_and_all_else_goes_on_as_with_joined_networks(whole):
    (_, after, _), _ = taken_over(whole)
    (_, joined, lines), _ = taken_over(whole, handover="join")
    group = after.groups[0]
    for copy in (group.actor_target, group.actor_average):
        assert_same_tree(copy, group.actor)
    assert_same_tree(group.critic_target, group.critic)
    for optimizer in (group.actor_optimizer, group.critic_optimizer):
        assert all(not np.asarray(leaf).any() for leaf in jax.tree.leaves(optimizer))
    keys = (jax.random.key_data(state.key) for state in (after, joined))
    np.testing.assert_array_equal(*keys)
    plain = [state._replace(groups=(), key=None) for state in (after, joined)]
    assert_same_tree(*plain)
    assert lines == []


def assert_same_tree(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def test_killed_before_its_first_checkpoint_it_learns_the_same_again(whole, tmp_path, capsys):
    copy = shutil.copytree(whole, tmp_path / "copy")
    shutil.rmtree(copy / "checkpoints")
    (copy / "summary.json").unlink()
    assert train.main([f"resume={copy}"]) == 0
    assert_same_run(copy, whole)
    said = capsys.readouterr().out
    assert "goes on with networks that have learned from these" in said and "agents: fitted to what" in said


def test_two_devices_that_share_a_seed(whole, tmp_path):
    """Each computes the same; the agents learned with other orders of summation."""
    assert train.main([*SPREAD, "seeds=1", f"out={tmp_path}", "name=one"]) == 0
    (one, after, _), (_, before) = taken_over(tmp_path / "one")
    assert one.trainer.sharding.devices_per_seed == 2
    lesson = Lesson(after.replay, before, 0, jax.random.key(9))
    assert lesson.critic_loss(member(after.groups[0].critic, 0, 0)) / 2 < 0.05 * lesson.values.var()
    for leaf in jax.tree.leaves(after.groups):
        parts = [np.asarray(shard.data) for shard in leaf.addressable_shards]
        assert len(parts) == 2
        np.testing.assert_array_equal(*parts)


def test_opponents_go_on_with_their_own_networks(tmp_path):
    given = [*SPREAD, "env=simple_adversary", "adversary=maddpg", "adversary.hidden=[5]", "adversary.policy_delay=1",
             "algo.distillation_updates=50", "seeds=2"]  # fmt: skip
    assert train.main([*given, f"out={tmp_path}", "name=run"]) == 0
    (one, after, _), (agents, before) = taken_over(tmp_path / "run")
    assert one.layout.agents == ("adversary_0", "agents") and agents.layout.num_agents == 3
    assert_same_tree(after.groups[0], before.groups[0])
    assert after.groups[1].actor["bias_0"].shape == (2, 1, 16)
    assert np.asarray(after.groups[0].critic_optimizer.count).min() > 0


@pytest.mark.parametrize(
    "settings, message",
    [
        (["algo=td3", "algo.handover=distill"], r"^algo\.handover=distill goes with algo=hybrid$"),
        (["algo=hybrid", "algo.handover=soft"], r"^algo\.handover='?soft'?: "),
        (["algo=hybrid", "algo.handover=distill", "algo.distillation_updates=0"], r"^algo\.distillation_updates=0: "),
    ],
)
def test_impossible_settings_are_one_line(settings, message):
    with pytest.raises(UserError, match=message):
        config.load(["env=simple_spread", *settings])
