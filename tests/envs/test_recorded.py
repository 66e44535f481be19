"""Every step of the recorded trajectories of the original programs, one at a time from the recorded state."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

from matd3_jax.envs import make
from matd3_jax.envs.particle.world import State

FILES = sorted((Path(__file__).parents[1] / "data" / "mpe").glob("*.npz"))
MODES = {"soft": "soft", "onehot": "soft", "discrete": "discrete", "continuous": "continuous"}


def environment(stem):
    """The environment a file was recorded from, by its name."""
    rules, task, counts, mode = re.fullmatch(
        r"(?:variant_)?(orig|mpe2)_(simple_(?:speaker_listener|[a-z]+))_(?:(.+)_)?(soft|onehot|discrete|continuous)",
        stem,
    ).groups()
    options = {}
    for key, value in re.findall(r"(N|ratio|good|adv|obs)(\d)", counts or ""):
        name = {"ratio": "local_ratio", "good": "num_good", "adv": "num_adversaries", "obs": "num_obstacles"}.get(key)
        options[name or {"simple_spread": "num_agents", "simple_adversary": "num_good"}[task]] = int(value)
    return make(task, rules=rules, actions=MODES[mode], **options)


def states(env, data, times, dtype):
    """The recorded states at `times`, all episodes: leading axis episodes x times."""
    episodes = len(data["pos"])

    def flat(x):
        return np.concatenate(x[:, times]).astype(dtype)

    def repeat(x, kind):
        return np.repeat(x, len(times), axis=0).astype(kind)

    return State(
        pos=flat(data["pos"]),
        vel=flat(data["vel"]),
        comm=flat(data["comm"]) if env.dim_c else None,
        landmark=repeat(data["landmark_pos"], dtype),
        goal=repeat(data["goal"], np.int32) if env.num_goals else None,
        key=repeat(data["key"], np.int32) if env.num_keys else None,
        step=np.tile(times, episodes).astype(np.int32),
    )


def check_observations(env, got, data, times, dtype):
    for i, observation in enumerate(got):
        want = np.concatenate(data[f"obs_{i}"][:, times])
        assert observation.dtype == dtype
        if dtype == np.float64 and want.dtype == np.float32:
            # mpe2 hands out observations rounded to float32, so they can be compared to one unit of that only.
            np.testing.assert_allclose(np.float32(observation), want, rtol=2**-23, atol=1e-10)
        else:
            # Some recorded states have mpe2's float32 observations: their rounding is far below 1e-5.
            np.testing.assert_allclose(observation, want, rtol=0, atol=1e-10 if dtype == np.float64 else 1e-5)


def test_all_recordings_are_there():
    assert len(FILES) == 36
    tasks = {(type(env).__name__, env.rules, env.actions) for env in (environment(file.stem) for file in FILES)}
    assert len(tasks) == 18  # six tasks: orig soft (also one-hot), mpe2 discrete, mpe2 continuous


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float64, np.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
def test_steps(file, dtype, observe_and_step):
    env, data = environment(file.stem), dict(np.load(file))
    start, end = np.arange(25), np.arange(1, 26)
    with jax.enable_x64(dtype == np.float64):
        action = tuple(
            np.concatenate(data[f"action_{i}"]).astype(np.int32 if env.actions == "discrete" else dtype)
            for i in range(len(env.agents))
        )
        seen, ts = jax.tree.map(np.asarray, observe_and_step(env)(states(env, data, start, dtype), action))
        want = states(env, data, end, dtype)
        tolerance = 1e-10 if dtype == np.float64 else 1e-5
        for name in ("pos", "vel", "comm", "landmark", "goal", "key", "step"):
            got_leaf, want_leaf = getattr(ts.state, name), getattr(want, name)
            assert (got_leaf is None) == (want_leaf is None)
            if got_leaf is not None:
                assert got_leaf.dtype == want_leaf.dtype
                np.testing.assert_allclose(got_leaf, want_leaf, rtol=0, atol=tolerance, err_msg=name)
        reward = np.concatenate(data["reward"])
        assert ts.reward.dtype == dtype
        # Rewards reach -35 and below: float32 carries 7 digits of that.
        np.testing.assert_allclose(ts.reward, reward, rtol=0 if dtype == np.float64 else 1e-5, atol=tolerance)
        check_observations(env, ts.observation, data, end, dtype)
        check_observations(env, seen, data, start, dtype)
        assert not ts.terminated.any()
        # The original never says done, its training loop stops at 25; mpe2 says it itself.
        last = np.tile(start == 24, len(data["pos"]))
        np.testing.assert_array_equal(ts.truncated, last)
        if env.rules == "mpe2":
            np.testing.assert_array_equal(data["done"].reshape(len(last), -1).T, [last] * len(env.agents))


@pytest.mark.parametrize("file", FILES, ids=[file.stem for file in FILES])
def test_bodies(file):
    """Sizes, limits and names are the recorded ones."""
    env, data = environment(file.stem), dict(np.load(file))
    world, n = env.world, len(env.agents)
    np.testing.assert_array_equal(data["entity_size"], world.radius + world.landmark_radius)
    np.testing.assert_array_equal(data["entity_collide"], world.collide + world.landmark_collide)
    np.testing.assert_array_equal(data["entity_movable"][:n], world.movable)
    assert not data["entity_movable"][n:].any()
    np.testing.assert_array_equal(data["agent_accel"], world.gain)
    limit = data["agent_max_speed"]
    np.testing.assert_array_equal(np.where(limit < 0, np.inf, limit), world.max_speed)
    np.testing.assert_array_equal(data["agent_silent"], [m or not env.dim_c for m in world.movable])
    if env.rules == "mpe2":
        assert tuple(data["agent_names"]) == env.agents
    if not env.dim_c:
        assert not data["comm"].any()
