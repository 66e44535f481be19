"""gymnasium's environments as ours, against stepping them by hand, and MaMuJoCo beside our own robots."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from host_cases import Corridor

from matd3_jax import envs
from matd3_jax.envs import Box, Discrete, OptionError
from matd3_jax.video.frames import drawing_of


@pytest.fixture(scope="module")
def ant():
    return envs.make("gymnasium", id="Ant-v5", split="2x4", observation="own")


def test_the_ant_shared_out(ant):
    """By joint names, as our own Ant's and MaMuJoCo's 2x4; actions and observations go where they belong."""
    envs.check(ant)
    own = gymnasium.make("Ant-v5").unwrapped
    joints = [own.model.joint(int(j)).name for j in own.model.actuator_trnid[:, 0]]
    left = [joints.index(name) for name in ("hip_1", "ankle_1", "hip_2", "ankle_2")]
    right = [joints.index(name) for name in ("hip_3", "ankle_3", "hip_4", "ankle_4")]
    assert ant.shares == (tuple(left), tuple(right))
    assert ant.agents == ("agent_0", "agent_1") and ant.action_spaces == (Box(4, -1.0, 1.0),) * 2
    assert ant.episode_length == 1000 and ant.return_weights == (0.5, 0.5) and ant.full_observation_size == 105
    reset, step = jax.jit(ant.reset), jax.jit(ant.step)
    state, _ = reset(jax.random.key(0))
    full, _ = own.reset(seed=int(state.seed))
    np.testing.assert_array_equal(ant.full_observation(state), full.astype(np.float32))
    for t in range(5):
        actions = [np.random.default_rng(t).uniform(-1, 1, 4).astype(np.float32) for _ in range(2)]
        actions[1] = -actions[1][::-1]
        joint = np.zeros(8, np.float32)
        joint[left], joint[right] = actions
        ts = step(jax.random.key(0), state, tuple(map(jnp.asarray, actions)))
        full, reward, terminated, truncated, info = own.step(joint)
        state = ts.state
        np.testing.assert_array_equal(ant.full_observation(state), full.astype(np.float32))
        np.testing.assert_allclose(ts.reward, [reward] * 2, rtol=1e-6)
        np.testing.assert_allclose(ant.measure(state), [info["x_velocity"]], rtol=1e-6)
        np.testing.assert_array_equal(ant.qpos(state), own.data.qpos.astype(np.float32))
        assert not terminated and not truncated and not ts.terminated and not ts.truncated
        qpos, qvel = own.data.qpos.astype(np.float32), own.data.qvel.astype(np.float32)
        for agent, mine in enumerate(
            (("hip_1", "ankle_1", "hip_2", "ankle_2"), ("hip_3", "ankle_3", "hip_4", "ankle_4"))
        ):
            places = [own.model.joint(name).qposadr[0] for name in mine]
            speeds = [own.model.joint(name).dofadr[0] for name in mine]
            want = [*qpos[2:7], *qvel[:6], *qpos[places], *qvel[speeds]]  # no x and y in the observation
            np.testing.assert_array_equal(ts.observation[agent], want)
    assert drawing_of(ant).legend and ant.agent_bodies[0] == (2, 3, 4, 5, 6, 7)


def test_truncation():
    env = envs.make("gymnasium", id="Reacher-v5", split="2x1")
    keys, actions = jax.random.split(jax.random.key(0), 2), (jnp.zeros((2, 1)),) * 2
    both = jax.jit(jax.vmap(env.step_or_reset))
    state, _ = jax.jit(jax.vmap(env.reset))(keys)
    for t in range(1, 52):
        after, state, _ = both(keys, keys, state, actions)
        assert (np.asarray(after.truncated) == (t == 50)).all() and not after.terminated.any()
    assert state.step.tolist() == [1, 1] and env.episode_length == 50
    longer = envs.make("gymnasium", id="Reacher-v5", episode_length=60)
    assert longer.episode_length == 60 and longer.facts.limit == 60


def test_choices_and_termination():
    env = envs.from_gymnasium(Corridor, episode_length=6)
    envs.check(env)
    assert env.action_spaces == (Discrete(2),) and env.observation_sizes == (5,) and env.measures == ()
    state, seen = env.reset(jax.random.key(0))
    assert seen[0].tolist() == [1, 0, 0, 0, 0]
    ends = []
    for action in (1, 1, 0, 1, 1, 1):
        ts = env.step(None, state, (jnp.int32(action),))
        state = ts.state
        ends.append((float(ts.reward[0]), bool(ts.terminated), bool(ts.truncated)))
    assert ends == [(0, False, False)] * 5 + [(1, True, True)] and ts.observation[0].tolist() == [0, 0, 0, 0, 1]
    assert not hasattr(env, "mj_model")
    pole = envs.make("gymnasium", id="CartPole-v1")
    state, _ = pole.reset(jax.random.key(0))
    while not ts.reward[0] == 0:
        ts = pole.step(None, state, (jnp.int32(0),))
        state = ts.state
    assert ts.terminated and not ts.truncated and 5 < int(state.step) < 15


SPLITS = {
    ("Hopper-v5", "3x1"): ((0,), (1,), (2,)),
    ("HalfCheetah-v5", "2x3"): ((0, 1, 2), (3, 4, 5)),
    ("Reacher-v5", "halves"): ((0,), (1,)),
    ("Pusher-v5", "7x1"): tuple((i,) for i in range(7)),
    ("Pusher-v5", ((0, 1, 2, 6), (3, 5), (4,))): ((0, 1, 2, 6), (3, 5), (4,)),
}


@pytest.mark.parametrize(("name", "split"), SPLITS)
def test_splits(name, split):
    assert envs.make("gymnasium", id=name, split=split).shares == SPLITS[name, split]


REFUSED = [
    ({"id": None}, "must name an environment of gymnasium"),
    ({"id": "Ant-v77"}, "env.id=Ant-v77"),
    ({"id": "Aunt-v5"}, "did you mean 'Ant-v5'"),
    ({"id": "no_such_package:Game-v0"}, "no_such_package"),
    ({"id": "CartPole-v1", "kwargs": {"gravity": 3}}, "cannot be made with env.kwargs={'gravity': 3}"),
    ({"id": "CartPole-v1", "split": "halves"}, "only a Box can be shared"),
    ({"id": "CartPole-v1", "observation": "own"}, "nobody's own are known"),
    ({"id": "Reacher-v5", "observation": "own"}, "nobody's own are known"),
    ({"id": "Ant-v5", "observation": "mine"}, "must be one of 'all', 'own'"),
    ({"id": "Ant-v5", "split": "8x1"}, "an action has 8 entries"),
    ({"id": "Ant-v5", "split": "2x5"}, "did you mean '2x4'"),
    ({"id": "Pusher-v5", "split": "halves"}, "an action has 7 entries; did you mean"),
    ({"id": "Ant-v5", "split": [[0, 1], [2, 3]]}, "must be exactly one agent's"),
    ({"id": "Ant-v5", "split": [[0, 1, 2, 3], [3, 4, 5, 6, 7]]}, "must be exactly one agent's"),
    ({"id": "Ant-v5", "split": 3}, "or one list of the action's entries"),
    ({"id": "Ant-v5", "episode_length": 0}, "must be an integer of at least 1"),
]


@pytest.mark.parametrize(("options", "words"), REFUSED)
def test_what_cannot_be_is_refused_in_a_line(options, words):
    with pytest.raises(OptionError) as error:
        envs.make("gymnasium", **options)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_endless_ones_need_a_limit():
    with pytest.raises(OptionError, match="Corridor has no time limit of its own: give env.episode_length="):
        envs.from_gymnasium(Corridor)


# ---- MaMuJoCo beside our own robots ----------------------------------------------------------------------------------


def margins(model):
    """Contacts begin where they did before MuJoCo 3.5.0, as in our robots (`engines.models.corrected`)."""
    model.geom_margin /= 2


ROBOTS = {
    "ant": ({"scenario": "Ant", "agent_conf": "2x4", "agent_obsk": 1}, {"split": "2x4", "depth": 1}),
    "half_cheetah": ({"scenario": "HalfCheetah", "agent_conf": "2x3", "agent_obsk": 0}, {"split": "2x3", "depth": 0}),
}


@pytest.mark.parametrize("name", ROBOTS)
def test_mamujoco_returns_what_our_robots_do(name):
    """The same joint actions from the same start, both in C MuJoCo: rewards, ends and observations."""
    from gymnasium_robotics import mamujoco_v1

    kwargs, options = ROBOTS[name]

    def make():
        env = mamujoco_v1.parallel_env(**kwargs)
        margins(env.single_agent_env.unwrapped.model)
        made.append(env)
        return env

    made: list = []
    theirs, ours = envs.from_pettingzoo(make, shared_reward=True), envs.make(name, physics="c", **options)
    assert envs.make("pettingzoo", id="gymnasium_robotics.mamujoco_v1", kwargs=kwargs).agents == theirs.agents
    assert theirs.return_weights == ours.return_weights == (0.5, 0.5) and theirs.episode_length == ours.episode_length
    steps = [jax.jit(env.step) for env in (theirs, ours)]
    state, _ = theirs.reset(jax.random.key(1))
    data = next(env for env in made if env.single_agent_env.unwrapped.data.time == 0).single_agent_env.unwrapped.data
    mine = ours.state(jnp.asarray(data.qpos, jnp.float32), jnp.asarray(data.qvel, jnp.float32))
    total = np.zeros(2)
    for t in range(40):
        keys = jax.random.split(jax.random.key(t))
        action = tuple(0.5 * space.sample(k) for space, k in zip(ours.action_spaces, keys, strict=True))
        their_step, my_step = steps[0](None, state, action), steps[1](keys[0], mine, action)
        state, mine = their_step.state, my_step.state
        # Ours rounds the state to float32 between env steps: small at first, then as chaotic as the robot.
        tolerance = 1e-5 if t < 5 else 5e-3
        np.testing.assert_allclose(their_step.reward, my_step.reward, rtol=tolerance, atol=tolerance)
        assert bool(their_step.terminated) == bool(my_step.terminated)
        total += [float(their_step.reward[0]), float(my_step.reward[0])]
        if t == 3:
            for seen, own in zip(their_step.observation, my_step.observation, strict=True):
                np.testing.assert_allclose(seen, own, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(*total, rtol=1e-4)
