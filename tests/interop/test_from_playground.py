"""Tasks of MuJoCo Playground against Playground's own steps."""

import importlib.util
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from playground_models import write

import matd3_jax
from matd3_jax import config, envs
from matd3_jax.envs import Box, OptionError
from matd3_jax.interop import from_playground

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

installed = pytest.mark.skipif(
    importlib.util.find_spec("mujoco_playground") is None,
    reason="MuJoCo Playground is not installed (the extra 'playground')",
)


def test_without_playground(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_playground", None)
    with pytest.raises(
        OptionError, match=r"env=playground needs the extra 'playground': pip install 'matd3_jax\[playg"
    ):
        envs.make("playground", id="PendulumSwingup", split="single", kwargs={"ctrl_dt": 0.5})


def test_settings():
    settings = config.load(["env=playground", "env.id=CheetahRun", "env.split=3x2", "env.kwargs.noise.level=0"])
    assert settings.env["kwargs"] == {"noise": {"level": 0}} and settings.recipe == "fast"


@installed
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "needs an id"),
        ({"id": "CheetaRun"}, "no such task; did you mean 'CheetahRun'"),
        ({"id": "PendulumSwingup", "impl": "mjx"}, "impl='mjx': must be one of 'jax', 'warp'"),
        ({"id": "PendulumSwingup", "observation": "some"}, "observation='some'"),
        ({"id": "PendulumSwingup"}, "one actuator, 'torque'; take split=single"),
        ({"id": "PendulumSwingup", "kwargs": {"speed": 1}}, "cannot make it with .*speed"),
        ({"id": "PendulumSwingup", "split": "single", "episode_length": 0}, "episode_length=0"),
    ],
)
def test_what_is_refused(options, words):
    with pytest.raises(OptionError, match=words):
        envs.make("playground", **options)


@installed
def test_models_that_cannot_be_downloaded(monkeypatch, tmp_path, capsys):
    """One line with the way on, and what Playground itself prints is kept back."""
    from mujoco_playground._src import locomotion, mjx_env

    def fail(*arguments):
        print("Error downloading", file=sys.stderr)
        raise RuntimeError("no network")

    monkeypatch.setattr(mjx_env, "_clone_with_progress", fail)
    monkeypatch.setattr(mjx_env, "EXTERNAL_DEPS_PATH", tmp_path)
    monkeypatch.setattr(mjx_env, "MENAGERIE_PATH", tmp_path / "mujoco_menagerie")
    monkeypatch.setattr(from_playground, "_menagerie", lambda: tmp_path / "mujoco_menagerie")
    assert "Go1JoystickRoughTerrain" in locomotion.ALL_ENVS
    with pytest.raises(OptionError, match="needs the robots' models, .*no network.*git clone https"):
        envs.make("playground", id="Go1JoystickRoughTerrain")
    said = capsys.readouterr()
    assert "Error" not in said.err and "downloads the robots' models" in said.out + said.err


@pytest.fixture(scope="module")
def cheetah():
    env = envs.make("playground", id="CheetahRun", split="2x3", episode_length=4)
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    return env, reset, step


@installed
@pytest.mark.slow
def test_the_numbers_are_playgrounds(cheetah):
    env, reset, step = cheetah
    envs.check(env)
    assert env.agents == ("agent_0", "agent_1") and env.action_spaces == (Box(3, -1.0, 1.0),) * 2
    theirs = from_playground.import_registry().load("CheetahRun", config_overrides={"impl": "jax"})
    their_step = jax.jit(theirs.step)
    key = jax.random.key(1)
    state, observation = reset(key)
    want = jax.jit(theirs.reset)(jax.random.key_data(key))
    np.testing.assert_allclose(env.full_observation(state), want.obs, atol=1e-6)
    for t in range(4):
        action = jax.random.uniform(jax.random.key(t), (6,), minval=-1)
        ts = step(key, state, (action[:3], action[3:]))
        want = their_step(want, action)
        np.testing.assert_allclose(env.full_observation(ts.state), want.obs, atol=1e-4)
        np.testing.assert_allclose(ts.reward, np.full(2, want.reward), atol=1e-5)
        assert not ts.terminated and bool(ts.truncated) == (t == 3)
        state = ts.state
    # The observation: height, pitch, six joints, three velocities of the root, six of the joints.
    own = [[0, 1, 2, 3, 4, 8, 9, 10, 11, 12, 13], [0, 1, 5, 6, 7, 8, 9, 10, 14, 15, 16]]
    for seen, entries in zip(env.observe(state), own, strict=True):
        np.testing.assert_array_equal(seen, env.full_observation(state)[np.array(entries)])


@installed
@pytest.mark.slow
def test_physics_that_blows_up_terminates_without_a_reward(cheetah):
    env, reset, step = cheetah
    state, _ = reset(jax.random.key(0))
    data = state.inner.data
    wild = state._replace(inner=state.inner.replace(data=data.replace(qvel=data.qvel.at[0].set(jnp.nan))))
    ts = step(jax.random.key(0), wild, (jnp.zeros(3), jnp.zeros(3)))
    assert ts.terminated and not ts.truncated and (ts.reward == 0).all()
    assert all(np.isfinite(seen).all() for seen in ts.observation)


@installed
@pytest.mark.slow
def test_stepping_leaves_the_state_that_it_was_given(cheetah):
    """Tasks write into the dictionaries of a state."""
    env, reset, _ = cheetah
    state, _ = reset(jax.random.key(0))
    before = dict(state.inner.info)
    jax.eval_shape(env.step, jax.random.key(0), state, (jnp.zeros(3), jnp.zeros(3)))
    assert all(state.inner.info[name] is value for name, value in before.items())


@installed
@pytest.mark.slow
@pytest.mark.parametrize("id", ["CheetahRun", "HopperHop", "WalkerWalk", "HumanoidRun", "SwimmerSwimmer6", "BallInCup"])
def test_entries_that_belong_to_an_actuator_tell_of_its_joint_alone(id):
    """By moving each joint, and its velocity, in the simulator, and seeing which entries move."""
    from mujoco import mjx

    env = envs.make("playground", id=id, split="single")
    task, model, owners = env.wrapped, env.mj_model, env._loaded.owners
    state = jax.jit(env.reset)(jax.random.key(0))[0].inner
    joints = model.actuator_trnid[:, 0]
    places = model.jnt_qposadr[joints], model.jnt_dofadr[joints]

    @jax.jit
    def shown(qpos, qvel):
        data = mjx.forward(task.mjx_model, state.data.replace(qpos=qpos, qvel=qvel))
        return task._get_obs(data, dict(state.info))

    base = np.asarray(shown(state.data.qpos, state.data.qvel))
    assert len(owners) == base.size and set(owners) == {None, *range(model.nu)}
    for actuator in range(model.nu):
        moved = [
            np.asarray(shown(state.data.qpos.at[places[0][actuator]].add(0.1), state.data.qvel)) - base,
            np.asarray(shown(state.data.qpos, state.data.qvel.at[places[1][actuator]].add(0.1))) - base,
        ]
        for entry, owner in enumerate(owners):
            if owner is not None:
                assert any(abs(change[entry]) > 0.05 for change in moved) == (owner == actuator), (entry, owner)


@installed
@pytest.mark.slow
def test_a_quadruped_by_legs_with_an_observation_for_critics(monkeypatch, tmp_path):
    """The robot's meshes are small stand-ins: its contacts and masses are in Playground's own files."""
    import mujoco_playground
    from etils import epath
    from mujoco_playground._src import mjx_env

    xmls = Path(mujoco_playground.__file__).parent / "_src" / "locomotion" / "go1" / "xmls"
    write(xmls, tmp_path / "unitree_go1" / "assets")
    monkeypatch.setattr(mjx_env, "MENAGERIE_PATH", epath.Path(tmp_path))
    monkeypatch.setattr(from_playground, "_menagerie", lambda: tmp_path)
    env = envs.make("playground", id="Go1JoystickFlatTerrain", split="legs", kwargs={"noise_config": {"level": 0.0}})
    envs.check(env)
    assert len(env.agents) == 4 and env.observation_sizes == (21,) * 4 and env.full_observation_size == 123
    assert env.episode_length == 1000 and "reward_tracking_lin_vel" in env.measures
    shapes = jax.eval_shape(env.reset, jax.random.key(0))[0]
    assert shapes.inner.obs["state"].shape == (48,)
    # Of the third leg (the rear right one): what is everybody's, its joints, their velocities, its last action.
    expected = [*range(9), *range(15, 18), *range(27, 30), *range(39, 42), *range(45, 48)]
    np.testing.assert_array_equal(env.seen[2], expected)
    assert len({body for own in env.agent_bodies for body in own}) == 12


@installed
@pytest.mark.slow
def test_a_run_learns():
    """Random play has a return of 3.0, two seeds have 50 to 65 after as many env steps."""
    result = matd3_jax.train(
        *("env.id=CheetahRun", "env.split=2x3", "seeds=1", "total_steps=100_000", "eval_every=0", "log_every=5_000"),
        env="playground",
    )
    returns = result.metrics["return_agents"][0]
    first, *_, last = returns[np.isfinite(returns)]
    assert first < 10 and last > 25
