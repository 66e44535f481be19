"""One agent that begins with the networks of a team's agents (init= of single-agent algorithms)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from matd3_jax import config, envs
from matd3_jax.core import acting
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.core.running_statistics import Statistics
from matd3_jax.envs.wrappers.joint_team import JointTeam
from matd3_jax.errors import UserError
from matd3_jax.training import checkpoint, handover, starting
from matd3_jax.training.recording import Recorder
from matd3_jax.training.session import TrainingSession

pytestmark = pytest.mark.slow

SMALL = [
    "num_envs=2", "rollout_length=2", "batch_size=8", "learning_starts=100", "replay_capacity=400", "log_every=100",
    "total_steps=200", "eval_every=0", "shared_minibatch=false", "n_step=1", "recipe=paper", "algo.policy_delay=1",
]  # fmt: skip


def saved(path, *settings):
    Recorder().start(config.load([*settings, *SMALL]), path)
    training = TrainingSession(config.read(path / "config.yaml"))
    return training, checkpoint.restore_actors(checkpoint.verify(path / "checkpoints"), training.trainer)


def begun(path, *settings):
    """A session of one agent that begins with a run, and its state."""
    training = TrainingSession(config.load([f"init={path}", *settings, *SMALL]))
    fresh = training.trainer.init(training.keys())
    return training, starting.put(training.trainer, fresh, starting.gather(training), training.share)


def perceptron(params, inputs):
    """Outputs of one network in float64, without the project's code."""
    layers = sum(name.startswith("kernel") for name in params)
    for layer in range(layers):
        kernel, bias = (np.asarray(params[f"{what}_{layer}"], np.float64) for what in ("kernel", "bias"))
        inputs = inputs @ kernel + bias
        inputs = inputs if layer == layers - 1 else np.maximum(inputs, 0)
    return inputs


def of(tree, *where):
    return {name: np.asarray(leaf)[where] for name, leaf in tree.items()}


def places(training):
    return [training.layout.place(i) for i in range(training.layout.num_agents)]


def states(env, number):
    """States that no agent has chosen: resets, then random steps."""
    state, observation = jax.vmap(env.reset)(jax.random.split(jax.random.key(3), number))
    for k in range(3):
        keys = jax.random.split(jax.random.key(k), (1 + len(env.agents), number))
        action = []
        for i, space in enumerate(env.action_spaces):
            one = jax.random.uniform(jax.random.key(10 * k + i), (number, space.size))
            action.append(one if hasattr(space, "sizes") else space.low + (space.high - space.low) * one)
        after = jax.vmap(env.step)(keys[0], state, tuple(action))
        state, observation = after.state, after.observation
    return state, [np.asarray(o) for o in observation]


HOPPER = ["env=hopper", "env.physics=c", "algo.actor_output=tanh", "algo.actor_average=0.1"]
SPREAD = ["env=simple_spread", "normalize_observations=true"]


@pytest.fixture(scope="module", params=[HOPPER, SPREAD], ids=["hopper", "simple_spread"])
def pair(request, tmp_path_factory):
    """A team's run of two seeds, and one agent of three seeds that begins with it."""
    path = tmp_path_factory.mktemp("team") / "run"
    there = saved(path, *request.param, "algo=matd3", "algo.hidden=[8,6]", "seeds=2", "seed=4")
    return there, begun(path, *request.param, "algo=td3", "algo.hidden=[24,18]", "seeds=3", "seed=4")


@pytest.fixture(scope="module")
def seen(pair):
    """What the agents see and what one agent in their place sees, in states that no policy led to."""
    (there, _), (here, _) = pair
    state, observation = states(there.env, 7)
    (full,) = jax.vmap(here.env.observe)(state)
    return observation, np.asarray(full)


def test_it_does_what_the_agents_do(pair, seen):
    (there, team), (here, one) = pair
    observation, full = seen
    average = there.config.algo.actor_average > 0
    mine, theirs = (s.trainer.policy(state, average=average) for s, state in ((here, one), (there, team)))
    for seed, row in enumerate([0, 1, 0]):
        take = jax.tree.map(lambda leaf, k=row: leaf[k], theirs)
        wanted = acting.act(there.layout, take, [jnp.asarray(o) for o in observation], None)
        take = jax.tree.map(lambda leaf, k=seed: leaf[k], mine)
        found = acting.act(here.layout, take, [jnp.asarray(full)], None)
        np.testing.assert_allclose(found, wanted, atol=2e-6)
        assert np.std(wanted) > 1e-3


@pytest.mark.parametrize("part", ["critic", "critic_target"])
def test_its_critics_give_the_mean_of_the_agents_values(pair, seen, part):
    """Both as perceptrons in float64; observations as they are, whatever they are normalized by."""
    (there, team), (here, one) = pair
    observation, full = seen
    action = np.random.default_rng(0).normal(size=(7, there.layout.action_size))
    for seed, row in enumerate([0, 1, 0]):
        for j in range(2):
            inputs = np.concatenate([*observation, action], axis=-1)
            each = [perceptron(of(getattr(team.groups[g], part), row, k, j), inputs) for g, k in places(there)]
            found = perceptron(of(getattr(one.groups[0], part), seed, 0, j), np.concatenate([full, action], axis=-1))
            np.testing.assert_allclose(found, np.mean(each, axis=0), rtol=1e-5, atol=1e-6)
            assert np.std(each) > 1e-3


def test_statistics_are_those_of_the_same_entries(pair):
    (there, team), (here, one) = pair
    if not there.config.normalize_observations:
        assert one.statistics is None
        return
    for mine, theirs in zip(one.statistics, team.statistics, strict=True):
        np.testing.assert_array_equal(np.asarray(mine)[:2], np.asarray(theirs)[:2])


@pytest.fixture(scope="module")
def spread(tmp_path_factory):
    path = tmp_path_factory.mktemp("spread") / "run"
    saved(path, "env=simple_spread", "algo=matd3", "algo.hidden=[8,6]", "seeds=1")
    return path


def test_where_agents_find_their_entries_in_the_full_observation():
    for name in ("hopper", "ant", "humanoid", "simple_tag", "point_reach"):
        env = envs.make(name, **({"physics": "c"} if name in ("hopper", "ant", "humanoid") else {}))
        state, observation = env.reset(jax.random.key(1))
        full = np.asarray(env.full_observation(state))
        for own, entries in zip(observation, env.entries_in_full_observation, strict=True):
            np.testing.assert_array_equal(own, full[list(entries)])


@pytest.mark.parametrize(
    "settings, message",
    [
        (["algo.hidden=[24,17]"], r"3 agents with hidden=\[8,6\] stand side by side in those of one agent with "
         r"hidden=\[24,18\], not \[24,17\]$"),
        (["algo.hidden=[24,18]", "algo.actor_output=tanh"], "agent_0 has actor_output=sigmoid there, agents actor_out"),
        (["algo.hidden=[24,18]", "algo.num_critics=1"], "agent_0 has num_critics=2 there, agents num_critics=1 here"),
        (["algo.hidden=[24,18]", "algo.critic_norm=layer"], "agent_0 has critic_norm=none there, agents critic_norm=l"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_named(spread, settings, message):
    with pytest.raises(UserError, match=message):
        begun(spread, "env=simple_spread", "algo=td3", *settings)


def test_entries_that_nobody_saw_have_no_statistics(tmp_path):
    """The Ant's halves do not see the torso's contact forces, one agent does."""
    layout = JointLayout.of(ant := envs.make("ant", physics="c"), {"agents": Algorithm()})
    team = handover.Team.of("init=x", "agents", layout, ant)
    size = ant.full_observation_size
    parts = [Statistics(np.ones((2, n)), np.ones((2, n))) for n in layout.observation_sizes]
    with pytest.raises(UserError, match="^init=x: one agent sees 12 entries that the agents did not"):
        handover.statistics("init=x", team, parts, size)
    params = {"kernel_0": np.ones((2, 59, 4), np.float32), "bias_0": np.ones((2, 4), np.float32)}
    joined = handover.actor(team, [params, params], size)["kernel_0"]
    unseen = sorted(set(range(size)) - {e for own in team.entries for e in own})
    assert len(unseen) == 12 and not joined[:, unseen].any() and joined.shape == (2, size, 8)


@pytest.mark.parametrize(
    ("before", "now", "sizes"), [(True, False, "111 numbers there, 97"), (False, True, "97 numbers there, 111")]
)
def test_one_agent_that_sees_other_entries_is_refused(before, now, sizes):
    """The Ant's agents learned with velocities, and one agent goes on without, or the other way around."""
    one = Algorithm(joint=True)
    there = JointLayout.of(ant := envs.make("ant", physics="c", velocities=before), {"agents": Algorithm()})
    here = JointLayout.of(JointTeam(envs.make("ant", physics="c", velocities=now)), {"agents": one})
    team = handover.Team.of("init=x", "agents", there, ant)
    with pytest.raises(UserError, match=f"^init=x: one agent in the place of agents sees {sizes} here$"):
        handover.networks("init=x", team, [], there, here, 0)
    with pytest.raises(UserError, match=sizes):
        handover.statistics("init=x", team, [], here.observation_sizes[0])


def test_whose_critics_see_more_than_the_one_agent_s(tmp_path):
    """One agent in the place of one of two teams has to see the other, too."""
    env = envs.make("simple_adversary")
    there = JointLayout.of(env, {"agents": Algorithm(), "adversaries": Algorithm()})
    joint = JointTeam(env, "agents")
    team = handover.Team.of("init=x", "agents", there, env)
    for critic in ("own", "central"):
        one = Algorithm(joint=True, critic=critic)
        here = JointLayout.of(joint, {"agents": one, "adversaries": Algorithm()})
        if critic == "own":
            with pytest.raises(UserError, match="critics of agent_0 see adversary_0, those of agents do not"):
                handover.critic_columns("init=x", team, there, here, 1)
        else:
            columns = handover.critic_columns("init=x", team, there, here, 1)
            assert columns == [list(range(here.observation_size + here.action_size))] * 2


@pytest.mark.parametrize("env", ["simple_tag", "simple_crypto"])
def test_both_teams_may_be_joined(env):
    """Each agent's critic finds the numbers that it saw, among them those of the other team's agents."""
    env = envs.make(env)
    both = {team: Algorithm(joint=True) for team in set(env.teams)}
    there = JointLayout.of(env, {team: Algorithm() for team in both})
    joint = functools.reduce(JointTeam, both, env)
    here = JointLayout.of(joint, both)
    rng = np.random.default_rng(1)
    seen = {name: rng.normal(size=n) for name, n in zip(there.agents, there.observation_sizes, strict=True)}
    acted = {name: rng.normal(size=space.size) for name, space in zip(there.agents, there.action_spaces, strict=True)}
    members = {team: [a for a, of in zip(there.agents, there.teams, strict=True) if of == team] for team in both}
    inputs = np.concatenate([part[a] for part in (seen, acted) for one in here.agents for a in members[one]])
    wanted = np.concatenate([part[a] for part in (seen, acted) for a in there.agents])
    for one, name in enumerate(here.agents):
        team = handover.Team.of("init=x", name, there, env)
        columns = handover.critic_columns("init=x", team, there, here, one)
        assert len(columns) == len(members[name])
        for own in columns:
            np.testing.assert_array_equal(inputs[own], wanted)
