"""The Ant, in C MuJoCo and in MJX, against recorded trajectories of the physics that Ant-v2 had (C MuJoCo 2.3.7)."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from matd3_jax.envs import OptionError, make
from matd3_jax.envs.robots.engines.models import CONTACT_POINTS

FILES = sorted((Path(__file__).parents[1] / "data" / "ant").glob("trajectory_*.npz"))
BATCH = 50


@pytest.fixture(scope="module", params=["c", "mjx"])
def ant(request):
    return make("ant", physics=request.param)


@pytest.fixture(scope="module")
def step(ant):
    """States, controls [50, 8] -> time steps: one compiled program for all tests."""
    program = jax.jit(jax.vmap(lambda state, action: ant.step(None, state, ant_actions(ant, action))))
    return lambda states, actions: jax.device_get(program(states, jnp.asarray(actions, jnp.float32)))


@pytest.fixture(scope="module")
def recorded():
    """Arrays [5 trajectories, ...]."""
    data = [np.load(file) for file in FILES]
    return {key: np.stack([d[key] for d in data]) for key in data[0].files if key not in ("kind", "engine")}


def ant_actions(ant, control):
    """Each agent's own controls."""
    return tuple(control[jnp.array(own)] for own in ant.partition.actuators)


def states(ant, qpos, qvel, torso_x):
    """States of Ant-v2 at positions [batch, 15] and velocities [batch, 14] on the way."""

    def one(qpos, qvel, x):
        return ant.state(qpos, qvel)._replace(progress=x)

    return jax.vmap(one)(*(jnp.asarray(part, jnp.float32) for part in (qpos, qvel, torso_x)))


@pytest.fixture(scope="module")
def single(ant, step, recorded):
    """(time steps, the recording) of one step from each of the 250 recorded states, side by side."""
    found = []
    for i in range(len(FILES)):
        before = (recorded["qpos"][i, :-1], recorded["qvel"][i, :-1], recorded["torso_xpos"][i, :-1, 0])
        found.append(step(states(ant, *before), recorded["action"][i]))
    return jax.tree.map(lambda *parts: np.stack(parts), *found)


def quantiles(error):
    """Median, 95 % quantile and maximum over all steps of the largest error in each [trajectories, steps, ...]."""
    largest = np.abs(error).reshape(*error.shape[:2], -1).max(axis=-1)
    return np.quantile(largest, [0.5, 0.95, 1])


SINGLE = {
    # Measured: (5e-8, 9e-8, 1.2e-7), (4e-7, 1e-6, 2.4e-6), (0, 1.3e-6, 1e-5): the state's rounding to float32. Twice
    # that, more for the maxima.
    "c": {"qpos": (1e-7, 2e-7, 4e-7), "qvel": (1e-6, 2e-6, 1e-5), "forces": (1e-8, 3e-6, 4e-5)},
    # Twice what was measured with many more solver iterations (Newton 100/50), in float32.
    "mjx": {"qpos": (4e-7, 8e-7, 1e-5), "qvel": (3e-6, 1.2e-5, 1.6e-3), "forces": (1e-7, 8e-5, 2e-3)},
}


@pytest.mark.slow
def test_single_steps_end_where_those_of_the_recording_end(ant, single, recorded):
    state = single.state
    errors = {
        "qpos": (state.qpos - recorded["qpos"][:, 1:])[..., 2:],
        "qvel": state.qvel - recorded["qvel"][:, 1:],
        "forces": state.sensed[0] - np.clip(recorded["cfrc_ext"][:, 1:], -1, 1),
    }
    for name, error in errors.items():
        assert (quantiles(error) < SINGLE[ant.physics][name]).all(), (name, quantiles(error))


def test_the_recording_has_contacts_to_speak_of(recorded):
    touching = np.abs(recorded["cfrc_ext"]).reshape(5, 51, -1).max(axis=-1) > 0
    assert 0.2 < touching.mean() < 0.9


def test_rewards_are_those_of_the_recording(ant, single, recorded):
    # Measured: forward 2.7e-6 (c), 2e-4 (mjx); ctrl 3e-7 both; contact 3e-8, 1.2e-7.
    forward, contact = {"c": (1e-5, 1e-7), "mjx": (1e-3, 1e-5)}[ant.physics]
    terms = single.state.terms
    for k, (name, bound) in enumerate({"forward": forward, "survive": 0, "ctrl": 1e-6, "contact": contact}.items()):
        wanted = np.ones((5, 50)) if name == "survive" else recorded[f"reward_{name}"]
        np.testing.assert_allclose(terms[..., k], wanted, rtol=0, atol=bound, err_msg=name)
    both = np.repeat(recorded["reward_v2"][..., None], 2, axis=-1)
    np.testing.assert_allclose(single.reward, both, rtol=0, atol=forward)


def test_termination_is_that_of_the_recording(single, recorded):
    np.testing.assert_array_equal(single.terminated, recorded["terminated"])
    assert recorded["terminated"].any() and not recorded["terminated"].all()
    assert not single.truncated.any()


def test_the_full_observation_is_that_of_the_recording(ant, single, recorded):
    full = jax.vmap(jax.vmap(ant.full_observation))(single.state)
    error = quantiles(np.asarray(full) - recorded["obs_v2"][:, 1:])
    assert full.shape[-1] == ant.full_observation_size == 111
    # Measured: c 4e-7, 2e-6, 1e-5; mjx 1.4e-6, 4e-5, 8e-4.
    assert (error < {"c": (1e-6, 4e-6, 4e-5), "mjx": (4e-6, 8e-5, 2e-3)}[ant.physics]).all(), error


FREE = {
    # Contacts make it chaotic. Measured, median, 90 % quantile and maximum after 10 and 20 env steps: c 1.2e-7, 4e-7,
    # 8e-7 and 5e-7, 2e-6, 8e-6; mjx 4e-7, 3e-6, 3e-5 and 3e-6, 4e-5, 5e-3. Bounds: three times the median, more for
    # the tails.
    "c": {10: (4e-7, 1.6e-6, 8e-6), 20: (1.5e-6, 1e-5, 1e-4)},
    "mjx": {10: (1.3e-6, 1e-5, 3e-4), 20: (1e-5, 2e-4, 5e-2)},
}


def test_free_runs_stay_with_the_recording(ant, step, recorded):
    """From ten states of each recording."""
    bounds = FREE[ant.physics]
    starts = np.arange(0, 30, 3)

    def at(key, t):
        return recorded[key][:, starts + t].reshape(BATCH, *recorded[key].shape[2:])

    state = states(ant, at("qpos", 0), at("qvel", 0), at("torso_xpos", 0)[:, 0])
    for t in range(20):
        state = step(state, at("action", t)).state
        error = np.abs(state.qpos - at("qpos", t + 1))[:, 2:].max(axis=1)
        assert (np.quantile(error, [0.5, 0.9, 1]) < bounds.get(t + 1, np.inf)).all(), (t, error)


def test_a_state_that_blows_up_ends_the_episode_harmlessly(ant, step, recorded):
    qpos, qvel = recorded["qpos"][0, :-1].copy(), recorded["qvel"][0, :-1].copy()
    qvel[::2, 3] = np.nan
    qpos[1::4, 8] = np.inf
    qvel[3::8, 6] = 1e9
    broken = ~(np.isfinite(qpos).all(axis=1) & (np.abs(qvel) < 1e8).all(axis=1))
    after = step(states(ant, qpos, qvel, qpos[:, 0]), recorded["action"][0])
    np.testing.assert_array_equal(after.terminated, broken)
    assert (after.reward[broken] == 0).all()
    assert all((np.abs(part) <= 1e5).all() for part in after.observation)
    assert (after.reward[~broken] != 0).all()


def test_the_time_limit_truncates(ant, step, recorded):
    state = states(ant, recorded["qpos"][0, :-1], recorded["qvel"][0, :-1], recorded["qpos"][0, :-1, 0])
    state = state._replace(step=jnp.arange(975, 975 + BATCH, dtype=jnp.int32))
    after = step(state, recorded["action"][0])
    np.testing.assert_array_equal(after.truncated, np.arange(976, 976 + BATCH) >= 1000)
    np.testing.assert_array_equal(after.state.step, np.arange(976, 976 + BATCH))


def test_resets_are_those_of_ant_v2():
    ant, n = make("ant"), 4000
    state, observation = jax.vmap(ant.reset)(jax.random.split(jax.random.key(0), n))
    qpos = np.asarray(state.qpos)
    for i in (0, 1, 2, *range(7, 15)):
        noise = qpos[:, i] - (0.75 if i == 2 else 0)
        assert np.abs(noise).max() <= 0.1 + 1e-6
        assert abs(noise.mean()) < 5 * 0.1 / np.sqrt(3 * n)
        assert abs(noise.std() - 0.1 / np.sqrt(3)) < 0.003
    np.testing.assert_allclose(np.linalg.norm(qpos[:, 3:7], axis=1), 1, atol=1e-6)
    qvel = np.asarray(state.qvel)
    assert (abs(qvel.mean(axis=0)) < 5 * 0.1 / np.sqrt(n)).all()
    assert (abs(qvel.std(axis=0) - 0.1) < 5 * 0.1 / np.sqrt(2 * n)).all()
    assert (np.asarray(state.sensed[0]) == 0).all()
    assert [part.shape for part in observation] == [(n, 59)] * 2


def test_state_keeps_its_types(ant):
    # A weakly typed leaf would compile every program twice.
    state = jax.eval_shape(ant.reset, jax.random.key(0))[0]
    after = jax.eval_shape(lambda s: ant.step(None, s, (jnp.zeros(4), jnp.zeros(4))), state).state
    for before, now in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        assert (before.shape, before.dtype, before.weak_type) == (now.shape, now.dtype, now.weak_type)
        assert not now.weak_type


def test_agents_move_their_own_legs():
    ant = make("ant")
    left, right = jnp.arange(1.0, 5.0), jnp.arange(5.0, 9.0)  # hip and ankle of legs 1, 2; of legs 3, 4
    joints = (ant.mj_model.joint(j).name for j in ant.mj_model.actuator_trnid[:, 0])
    moved = dict(zip(joints, ant.control((left, right)), strict=True))
    assert moved == {f"{joint}_{leg}": 2 * leg - (joint == "hip") for leg in (1, 2, 3, 4) for joint in ("hip", "ankle")}


def test_reward_is_shared_and_reported_once():
    ant = make("ant")
    assert ant.return_weights == (0.5, 0.5)
    assert ant.measures == ("forward_velocity", "reward_forward", "reward_survive", "reward_ctrl", "reward_contact")


def test_mjx_fast_has_the_options_brax_takes():
    option = make("ant", physics="mjx_fast").mj_model.opt
    assert option.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert (option.iterations, option.ls_iterations) == (1, 4)
    assert option.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    for physics in ("c", "mjx"):
        assert make("ant", physics=physics).mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4


def test_random_play_touches_the_floor_in_fewer_points_than_mjx_keeps():
    model, rng = make("ant", physics="c").mj_model, np.random.default_rng(0)
    data = mujoco.MjData(model)
    most = 0
    for _ in range(40):
        mujoco.mj_resetData(model, data)
        data.qpos[3:7] = rng.normal(size=4)  # any way up
        for _ in range(100):
            data.ctrl[:] = rng.uniform(-1, 1, 8)
            mujoco.mj_step(model, data, 5)
            most = max(most, data.ncon)
    assert 4 <= most < CONTACT_POINTS


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"physics": "mjxx"}, "physics='mjxx': must be one of 'auto', 'c', 'mjx', 'mjx_fast'; did you mean 'mjx'"),
        ({"split": "2x4x"}, "ant has no such partition; did you mean '2x4'"),
        ({"split": [["hip_1", "knee_1"], ["hip_2"]]}, "no actuated joint 'knee_1'"),
        ({"episode_length": 0}, "episode_length=0"),
        ({"depth": -1}, "depth=-1"),
    ],
)
def test_impossible_options_are_named(options, message):
    with pytest.raises(OptionError, match=message):
        make("ant", **options)
