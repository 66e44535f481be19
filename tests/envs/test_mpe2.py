"""Side by side with the installed mpe2: same state, same actions, one step."""

import jax
import numpy as np
import pytest
from mpe2 import (
    simple_adversary_v3,
    simple_crypto_v3,
    simple_push_v3,
    simple_reference_v3,
    simple_speaker_listener_v4,
    simple_spread_v3,
    simple_tag_v3,
    simple_v3,
    simple_world_comm_v3,
)
from particle_cases import NUM_STATES, random_actions, random_states

from matd3_jax.envs import MultiDiscrete, make

TASKS = [
    # name, mpe2's module, our options, the same options in mpe2's words
    ("simple_spread", simple_spread_v3, {}, {}),
    ("simple_spread", simple_spread_v3, {"num_agents": 4, "local_ratio": 0.3}, {"N": 4, "local_ratio": 0.3}),
    ("simple_speaker_listener", simple_speaker_listener_v4, {}, {}),
    ("simple_crypto", simple_crypto_v3, {}, {}),
    ("simple_push", simple_push_v3, {}, {}),
    ("simple_adversary", simple_adversary_v3, {}, {}),
    ("simple_adversary", simple_adversary_v3, {"num_good": 3}, {"N": 3}),
    ("simple_tag", simple_tag_v3, {}, {}),
    (
        "simple_tag",
        simple_tag_v3,
        {"num_good": 3, "num_adversaries": 2, "num_obstacles": 1},
        {"num_good": 3, "num_adversaries": 2, "num_obstacles": 1},
    ),
    ("simple", simple_v3, {}, {}),
    ("simple_reference", simple_reference_v3, {}, {}),
    ("simple_reference", simple_reference_v3, {"local_ratio": 0.2}, {"local_ratio": 0.2}),
    ("simple_world_comm", simple_world_comm_v3, {}, {}),
    *(
        ("simple_world_comm", simple_world_comm_v3, options, options)
        for options in (
            {"num_good": 3, "num_adversaries": 2, "num_obstacles": 2, "num_food": 1, "num_forests": 3},
            {"num_good": 1, "num_adversaries": 1, "num_obstacles": 0, "num_food": 3, "num_forests": 0},
        )
    ),
]


class Draws:
    """Stands in for mpe2's generator at reset, so that mpe2 itself colors and assigns the goal and key we want."""

    def __init__(self, integers):
        self._integers = iter(integers)

    def integers(self, high):
        return next(self._integers)

    def uniform(self, low, high, size):
        return np.zeros(size)


def mpe2_action(space, action):
    """Movement and word as the one number that mpe2 takes for both."""
    return action[0] + space.sizes[0] * action[1] if isinstance(space, MultiDiscrete) else action


def mpe2_step(parallel, env, state, action):
    """What mpe2 shows in `state`, and everything after one step from there."""
    raw = parallel.unwrapped
    parallel.reset()
    drawn = [index for value in (state.goal, state.key) if value is not None for index in np.ravel(value)]
    raw.scenario.reset_world(raw.world, Draws(drawn))
    raw.steps = int(state.step)
    for i, agent in enumerate(raw.world.agents):
        agent.state.p_pos, agent.state.p_vel = state.pos[i].copy(), state.vel[i].copy()
        if state.comm is not None:
            agent.state.c = state.comm[i].copy()
    for i, landmark in enumerate(raw.world.landmarks):
        landmark.state.p_pos = state.landmark[i].copy()
    seen = [raw.observe(name) for name in env.agents]
    action = dict(zip(env.agents, map(mpe2_action, env.action_spaces, action), strict=True))
    assert all(map(np.array_equal, map(np.shape, action.values()), (parallel.action_space(a).shape for a in action)))
    observation, reward, terminated, truncated, _ = parallel.step(action)
    agents = raw.world.agents
    return {
        "seen": seen,
        "pos": np.array([agent.state.p_pos for agent in agents]),
        "vel": np.array([agent.state.p_vel for agent in agents]),
        "comm": np.array([agent.state.c for agent in agents]),
        "observation": [observation[name] for name in env.agents],
        "reward": np.array([reward[name] for name in env.agents]),
        "terminated": any(terminated.values()),
        "truncated": all(truncated.values()),
    }


@pytest.mark.slow
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize("task", TASKS, ids=lambda task: "-".join([task[0], *(f"{k}{v}" for k, v in task[2].items())]))
def test_steps(task, actions, observe_and_step):
    name, module, options, mpe2_options = task
    env = make(name, rules="mpe2", actions=actions, **options)
    parallel = module.parallel_env(continuous_actions=actions == "continuous", **mpe2_options)
    parallel.reset(seed=0)
    assert tuple(parallel.possible_agents) == env.agents
    rng = np.random.default_rng(TASKS.index(task))
    state, action = random_states(env, rng), random_actions(env, rng)

    with jax.enable_x64(True):
        seen, ts = jax.tree.map(np.asarray, observe_and_step(env)(state, action))
    rows = [jax.tree.map(lambda x: x[k], (state, action)) for k in range(NUM_STATES)]  # noqa: B023
    want = jax.tree.map(lambda *x: np.stack(x), *[mpe2_step(parallel, env, *row) for row in rows])

    assert ts.reward.dtype == np.float64
    np.testing.assert_allclose(ts.state.pos, want["pos"], rtol=0, atol=1e-10)
    np.testing.assert_allclose(ts.state.vel, want["vel"], rtol=0, atol=1e-10)
    if env.dim_c:
        np.testing.assert_allclose(ts.state.comm, want["comm"], rtol=0, atol=1e-10)
    np.testing.assert_allclose(ts.reward, want["reward"], rtol=0, atol=1e-10)
    for ours, theirs in ((seen, want["seen"]), (ts.observation, want["observation"])):
        for got, expected in zip(ours, theirs, strict=True):
            # mpe2 rounds observations to float32: equal to one unit of that.
            np.testing.assert_allclose(np.float32(got), expected, rtol=2**-23, atol=1e-10)
    assert not ts.terminated.any() and not want["terminated"].any()
    np.testing.assert_array_equal(ts.truncated, want["truncated"])
    assert want["truncated"].any() and not want["truncated"].all()
    assert [world_agent.silent for world_agent in parallel.unwrapped.world.agents] == [not s for s in env.speaks]
    if any(env.world.movable) and len(env.agents) > 1:  # contacts were put to the test
        gap = np.linalg.norm(state.pos[:, :, None] - state.pos[:, None], axis=-1) + 9 * np.eye(len(env.agents))
        assert (gap < np.add.outer(env.world.radius, env.world.radius)).any(axis=(1, 2)).sum() > 30
