"""JointTeam against the environment it wraps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from matd3_jax.envs import Box, Discrete, MultiDiscrete, OptionError, Simplex, make
from matd3_jax.envs.point_reach import PointReach
from matd3_jax.envs.wrappers.joint_team import JointTeam, join_spaces


def sample(env, key):
    """A random action of every agent."""
    spaces = env.action_spaces
    return jax.jit(lambda key: tuple(s.sample(jax.random.fold_in(key, i)) for i, s in enumerate(spaces)))(key)


@pytest.mark.parametrize("actions", ["soft", "discrete", "continuous"])
def test_everybody(actions):
    env = make("simple_spread", actions=actions)
    joint = JointTeam(env)
    assert joint.agents == joint.teams == ("agents",)
    assert joint.observation_sizes == (54,) and joint.full_observation_size == 54
    assert joint.return_weights == (3.0,) and joint.episode_length == 25
    space = {"soft": Simplex((5, 5, 5)), "discrete": MultiDiscrete((5, 5, 5)), "continuous": Box(6, -1.0, 1.0)}[actions]
    assert joint.action_spaces == (space,)

    state, observation = jax.jit(env.reset)(jax.random.key(0))
    joint_state, (joint_observation,) = jax.jit(joint.reset)(jax.random.key(0))
    np.testing.assert_array_equal(joint_observation, np.concatenate(observation))
    action = sample(env, jax.random.key(1))
    joint_action = jnp.stack(action) if actions == "discrete" else jnp.concatenate(action)
    assert joint_action.shape == space.shape
    want = jax.jit(env.step)(None, state, action)
    got = jax.jit(joint.step)(None, joint_state, (joint_action,))
    np.testing.assert_allclose(got.state.pos, want.state.pos, atol=1e-6)
    np.testing.assert_allclose(got.observation[0], env.full_observation(want.state), atol=1e-6)
    np.testing.assert_allclose(got.observation[0], joint.observe(want.state)[0], atol=1e-6)
    np.testing.assert_allclose(got.reward, [want.reward.mean()], rtol=1e-6)
    np.testing.assert_allclose(got.reward @ np.array(joint.return_weights), want.reward.sum(), rtol=1e-6)


def test_measures_are_the_wrapped_environments():
    """Names and numbers pass through; an environment that says nothing of measures has none."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Measured(PointReach):
        measures = ("target_x",)

        def measure(self, state):
            return state.target[:1]

    joint = JointTeam(Measured())
    state, _ = jax.jit(joint.reset)(jax.random.key(0))
    assert joint.measures == ("target_x",)
    np.testing.assert_array_equal(joint.measure(state), state.target[:1])
    plain = JointTeam(PointReach())
    assert plain.measures == () and plain.measure(state).shape == (0,)


def test_one_team_of_two():
    """Three predators become one agent in front of the prey; two prey become one behind the predators."""
    env = make("simple_tag", num_good=2, rules="mpe2")
    state, observation = jax.jit(env.reset)(jax.random.key(0))
    action = sample(env, jax.random.key(1))
    want = jax.jit(env.step)(None, state, action)

    hunters = JointTeam(env, "adversaries")
    assert hunters.agents == ("adversaries", "agent_0", "agent_1")
    assert hunters.teams == ("adversaries", "agents", "agents")
    assert hunters.return_weights == (3.0, 1.0, 1.0)
    assert hunters.action_spaces == (Simplex((5, 5, 5)), Simplex((5,)), Simplex((5,)))
    got = jax.jit(hunters.step)(None, state, (jnp.concatenate(action[:3]), action[3], action[4]))
    np.testing.assert_allclose(got.state.vel, want.state.vel, atol=1e-6)
    np.testing.assert_allclose(got.reward, [want.reward[:3].mean(), *want.reward[3:]], rtol=1e-6)
    assert tuple(map(len, got.observation)) == hunters.observation_sizes
    np.testing.assert_allclose(got.observation[0], np.concatenate(want.observation[:3]), atol=1e-6)
    np.testing.assert_allclose(got.observation[2], want.observation[4], atol=1e-6)

    hunted = JointTeam(env, ("agents",))
    assert hunted.agents == ("adversary_0", "adversary_1", "adversary_2", "agents")
    got = jax.jit(hunted.step)(None, state, (*action[:3], jnp.concatenate(action[3:])))
    np.testing.assert_allclose(got.state.vel, want.state.vel, atol=1e-6)
    np.testing.assert_allclose(got.reward, [*want.reward[:3], want.reward[3:].mean()], rtol=1e-6)
    np.testing.assert_allclose(got.observation[3], np.concatenate(want.observation[3:]), atol=1e-6)


@pytest.mark.parametrize("actions", ["soft", "discrete", "continuous"])
def test_a_team_of_which_one_speaks(actions):
    """The leader's movement and word come first in the joined action, then the others' movements."""
    env = make("simple_world_comm", num_adversaries=2, num_good=1, rules="mpe2", actions=actions)
    joint = JointTeam(env, "adversaries")
    space = {"soft": Simplex((5, 4, 5)), "discrete": MultiDiscrete((5, 4, 5)), "continuous": Box(14, 0.0, 1.0)}[actions]
    assert joint.action_spaces[0] == space and joint.observation_sizes == (2 * (14 + 4 + 2 + 2 + 4), 18 + 2)
    state, _ = jax.jit(env.reset)(jax.random.key(0))
    action = sample(env, jax.random.key(1))
    joined = jnp.concatenate([jnp.atleast_1d(a) for a in action[:2]])
    assert joined.shape == space.shape
    want = jax.jit(env.step)(None, state, action)
    got = jax.jit(joint.step)(None, state, (joined, action[2]))
    np.testing.assert_allclose(got.state.vel, want.state.vel, atol=1e-6)
    np.testing.assert_array_equal(got.state.comm, want.state.comm)
    np.testing.assert_allclose(got.observation[0], np.concatenate(want.observation[:2]), atol=1e-6)
    np.testing.assert_allclose(got.reward, [want.reward[:2].mean(), want.reward[2]], rtol=1e-6)


def test_both_teams():
    joint = JointTeam(make("simple_push"), ("agents", "adversaries"))
    assert joint.agents == ("agents+adversaries",) and joint.action_spaces == (Simplex((5, 5)),)
    (observation,) = jax.jit(joint.reset)(jax.random.key(0))[1]
    assert observation.shape == (27,)


def test_static():
    a, b = JointTeam(make("simple_tag"), "adversaries"), JointTeam(make("simple_tag"), ("adversaries",))
    assert a == b and hash(a) == hash(b) and a != JointTeam(make("simple_tag"), "agents")


def test_refusals():
    with pytest.raises(OptionError, match="'adversary'.*did you mean 'adversaries'"):
        JointTeam(make("simple_tag"), "adversary")
    with pytest.raises(OptionError, match="at least one team"):
        JointTeam(make("simple_tag"), ())
    with pytest.raises(OptionError, match="bounds differ"):  # the speaker's box and the listener's
        JointTeam(make("simple_speaker_listener", actions="continuous"))
    with pytest.raises(OptionError, match="kinds"):
        join_spaces((Simplex((3,)), Discrete(3)))
    assert join_spaces((MultiDiscrete((2, 3)), Discrete(4))) == MultiDiscrete((2, 3, 4))
