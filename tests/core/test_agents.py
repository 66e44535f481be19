"""Layout of joint vectors and rows against plain concatenation, and the groups and blocks of agents."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs import Box, Simplex, make
from matd3_jax.envs.wrappers.joint_team import JointTeam

MATD3, MADDPG = Algorithm(), Algorithm(name="maddpg", num_critics=1, policy_delay=1)
TASKS = (
    "simple_spread", "simple_speaker_listener", "simple_crypto", "simple_push", "simple_adversary", "simple_tag",
    "simple_reference", "simple_world_comm",
)  # fmt: skip


def environments():
    for name in TASKS:
        env = make(name)
        yield env
        for team in dict.fromkeys(env.teams):
            yield JointTeam(env, team)
    yield make("point_reach")
    yield JointTeam(make("simple_spread", actions="discrete"))
    yield JointTeam(make("simple_world_comm", actions="discrete"), "adversaries")


ENVIRONMENTS = tuple(environments())


def interleaved() -> JointLayout:
    """A, B, A: the first and the last agent are one group, the other stands between them."""
    return JointLayout(
        agents=("a0", "b", "a1"),
        teams=("agents",) * 3,
        observation_sizes=(2, 5, 2),
        action_spaces=(Simplex((3,)), Box(2, -1.0, 1.0), Simplex((3,))),
        algorithms=(MATD3,) * 3,
    )


def layout_of(env):
    return JointLayout.of(env, {team: MADDPG if team == "adversaries" else MATD3 for team in env.teams})


@pytest.mark.slow
@pytest.mark.parametrize("env", ENVIRONMENTS, ids=str)
def test_layout(env):
    """Rows and joint vectors of what the environment really gives: every part comes back where it was put, and a row is
    the plain concatenation x, actions, rewards, x', 1 - terminated."""
    layout, rng, lead = layout_of(env), np.random.default_rng(0), (4, 2)
    shapes = jax.eval_shape(env.reset, jax.random.key(0))[1]
    assert layout.observation_sizes == tuple(o.shape[0] for o in shapes)
    x, next_x = ([rng.normal(size=(*lead, o.shape[0])).astype(np.float32) for o in shapes] for _ in range(2))
    actions = [rng.normal(size=(*lead, space.size)).astype(np.float32) for space in env.action_spaces]
    reward = rng.normal(size=(*lead, len(env.agents))).astype(np.float32)
    terminated = rng.random(lead) < 0.5
    joint = [np.concatenate(parts, axis=-1) for parts in (x, actions, next_x)]
    assert (layout.observation_size, layout.action_size) == (joint[0].shape[-1], joint[1].shape[-1])

    truncated = rng.random(lead) < 0.5
    rows = layout.pack_rows(joint[0], joint[1], reward, joint[2], jnp.asarray(terminated), jnp.asarray(truncated))
    plain = np.concatenate([*x, *actions, reward, *next_x, 1.0 - terminated[..., None]], axis=-1)
    assert rows.shape == (*lead, layout.row_size) and rows.dtype == np.float32
    np.testing.assert_array_equal(rows, plain)

    parts = layout.row_parts(rows)
    for got, want in (
        (parts.x, joint[0]),
        (parts.action, joint[1]),
        (parts.inputs, np.concatenate(joint[:2], axis=-1)),
        (parts.reward, reward),
        (parts.next_x, joint[2]),
        (parts.discount, 1.0 - terminated),
    ):
        np.testing.assert_array_equal(got, want)
    for i in range(layout.num_agents):
        np.testing.assert_array_equal(layout.observation_part(parts.x, i), x[i])
        np.testing.assert_array_equal(layout.observation_part(parts.next_x, i), next_x[i])
        np.testing.assert_array_equal(layout.action_part(parts.action, i), actions[i])
    stacks = [np.stack([actions[i] for i in group.members]) for group in layout.groups]
    np.testing.assert_array_equal(layout.join_actions(stacks), joint[1])

    # With n_step > 1 only one entry more, before x'.
    assert parts.more is None
    several = dataclasses.replace(layout, n_step=3)
    longer = several.pack_rows(joint[0], joint[1], reward, joint[2], jnp.asarray(terminated), jnp.asarray(truncated))
    plain = [*x, *actions, reward, (~terminated & ~truncated)[..., None], *next_x, 1.0 - terminated[..., None]]
    np.testing.assert_array_equal(longer, np.concatenate(plain, axis=-1))
    assert several.row_size == longer.shape[-1]
    parts_longer = several.row_parts(longer)
    np.testing.assert_array_equal(parts_longer.more, ~terminated & ~truncated)
    for name in ("x", "action", "inputs", "reward", "next_x", "discount"):
        np.testing.assert_array_equal(getattr(parts_longer, name), getattr(parts, name))
    for columns, want in zip(several.observation_columns, (joint[0], joint[2]), strict=True):
        np.testing.assert_array_equal(longer[..., columns], want)


@pytest.mark.parametrize("layout", [*map(layout_of, ENVIRONMENTS), interleaved()], ids=lambda s: "-".join(s.agents))
def test_groups(layout):
    """Groups part the agents by observation size, action space and algorithm, everyone in one and in order."""
    kinds = list(zip(layout.observation_sizes, layout.action_spaces, layout.algorithms, strict=True))
    assert sorted(i for group in layout.groups for i in group.members) == list(range(layout.num_agents))
    assert len(layout.groups) == len(set(kinds))
    for group in layout.groups:
        assert list(group.members) == sorted(group.members)
        assert {kinds[i] for i in group.members} == {(group.observation_size, group.action_space, group.algorithm)}
    firsts = [group.members[0] for group in layout.groups]
    assert firsts == sorted(firsts)
    for i in range(layout.num_agents):
        g, k = layout.place(i)
        assert layout.groups[g].members[k] == i


def test_interleaved_groups():
    """Joint actions of A, B, A are put back into the order of the agents, not of the groups."""
    layout = interleaved()
    assert [group.members for group in layout.groups] == [(0, 2), (1,)]
    assert [layout.place(i) for i in range(3)] == [(0, 0), (1, 0), (0, 1)]
    a, b = np.arange(2 * 4 * 3).reshape(2, 4, 3), 100 + np.arange(4 * 2).reshape(1, 4, 2)
    np.testing.assert_array_equal(layout.join_actions([a, b]), np.concatenate([a[0], b[0], a[1]], axis=-1))
    assert (layout.observation_starts, layout.action_starts) == ((0, 2, 7), (0, 3, 5))


def test_teams_choose_the_algorithm():
    """Each agent has its own team's algorithm; agents alike but of different algorithms are two groups."""
    layout = layout_of(make("simple_push"))
    assert {team: a.name for team, a in zip(layout.teams, layout.algorithms, strict=True)} == {
        "adversaries": "maddpg",
        "agents": "matd3",
    }
    one = dataclasses.replace(interleaved(), algorithms=(MATD3, MATD3, MADDPG))
    assert [group.members for group in one.groups] == [(0,), (1,), (2,)]
    with pytest.raises(KeyError):
        JointLayout.of(make("simple_push"), {"agents": MATD3})
