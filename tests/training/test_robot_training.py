"""Robots through the whole loop: shared rewards, evaluations with measures, single-agent baselines."""

import jax
import numpy as np
import pytest

import matd3_jax
from matd3_jax import config
from matd3_jax.training import checkpoint
from matd3_jax.training.session import TrainingSession

SMALL = ("algo.hidden=[16]", "learning_starts=80", "replay_capacity=1000", "env.episode_length=20", "eval_episodes=2")


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["c", "mjx_fast"])
def test_the_ant_trains_and_is_evaluated(physics):
    result = matd3_jax.train(
        *SMALL, f"env.physics={physics}", env="ant", algo="matd3", num_envs=20, updates_per_collect=2, batch_size=1000,
        seeds=2, total_steps=400, eval_every=200, log_every=200,
    )  # fmt: skip
    table = result.metrics
    assert table["step"][0, -1] >= 400
    # One reward for both agents, reported once.
    np.testing.assert_array_equal(table["agent_0_return"], table["agent_1_return"])
    np.testing.assert_allclose(table["return_agents"], table["agent_0_return"], rtol=1e-6)
    there = ~np.isnan(table["eval_return_agents"])
    assert there[:, 0].all() and there[:, -1].all()
    terms = sum(table[f"eval_reward_{term}"][there] for term in ("forward", "survive", "ctrl", "contact"))
    # Means over the env steps of an episode times its length: the return, if no episode is cut short by a fall.
    whole = table["eval_episode_length"][there] == 20
    assert whole.any()
    np.testing.assert_allclose(20 * terms[whole], table["eval_return_agents"][there][whole], rtol=1e-4)
    velocity, forward = (table[f"eval_{name}"][there] for name in ("forward_velocity", "reward_forward"))
    np.testing.assert_allclose(velocity, forward)
    assert np.isfinite(table["agent_0_critic_loss"][:, 1:]).all()


@pytest.mark.parametrize(
    ("overrides", "observations", "actions"),
    [
        (["algo=matd3"], (59, 59), (4, 4)),
        (["algo=td3"], (111,), (8,)),
        (["algo=ddpg", "env.split=4x2"], (111,), (8,)),
        (["algo=iltd3", "env.split=4x2", "env.depth=2"], (45,) * 4, (2,) * 4),
        (["algo=maddpg", "env.split=single"], (111,), (8,)),
        (["algo=matd3", "env.velocities=false"], (49, 49), (4, 4)),
        (["algo=td3", "env.velocities=false"], (97,), (8,)),
        (["algo=matd3", "env.split=[[hip_1,hip_2,hip_3,hip_4],[ankle_1,ankle_2,ankle_3,ankle_4]]"], (71, 47), (4, 4)),
    ],
)
def test_agents_see_what_their_split_says(overrides, observations, actions):
    training = TrainingSession(config.load(["env=ant", *overrides]))
    assert training.layout.observation_sizes == observations
    assert tuple(space.size for space in training.layout.action_spaces) == actions
    assert training.team_weights("agents").sum() == 1


OPTIONS = (
    *SMALL, "algo.exploration_noise=[0.05,0.4]", "algo.actor_average=0.1", "n_step=3", "shared_minibatch=true",
    "num_envs=4", "batch_size=32", "env.episode_length=9", "log_every=80", "diagnostics.q_bias=true",
    "diagnostics.q_bias_steps=5", "diagnostics.q_bias_rollouts=6", "eval_every=80",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "seeds", "more"),
    [
        ("ant", 3, ()),
        ("humanoid", 1, ()),
        ("hopper", 1, ("env.velocities=false", "normalize_observations=true")),
    ],
)
def test_a_resumed_robot_is_the_same_to_the_bit(env, seeds, more, tmp_path):
    """With C physics, whatever carries state: the solver's start, noise quantiles, averaged actors, the reservoir."""
    settings = config.load([f"env={env}", "env.physics=c", *OPTIONS, *more, f"seeds={seeds}", "total_steps=400"])

    def go_on(training, state):
        rows = []
        for _ in range(2):
            state, row = training.advance(state)
            rows.append(row)
        return state, rows

    first = TrainingSession(settings)
    state, _ = first.start()
    state, _ = first.advance(state)
    checkpoint.save(tmp_path, first.step(state), first.trainer, state, keep=1)
    whole, rows = go_on(first, state)
    second = TrainingSession(settings)
    resumed, others = go_on(second, checkpoint.restore(checkpoint.verify(tmp_path), second.trainer))
    for a, b in zip(jax.tree.leaves(whole._replace(key=())), jax.tree.leaves(resumed._replace(key=())), strict=True):
        np.testing.assert_array_equal(a, b)
    for row, other in zip(rows, others, strict=True):
        assert row.keys() == other.keys()
        for name in row:
            np.testing.assert_array_equal(row[name], other[name], err_msg=name)
    assert np.isfinite(rows[-1]["agent_0_q_true"]).all() and np.isfinite(rows[-1]["eval_return_agents"]).all()
    assert any("noise_quantile" in jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_leaves_with_path(whole))
