"""Every robot, in C MuJoCo and in MJX, compared with gymnasium's version 5 of it: one step from each visited state."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from matd3_jax.envs import make
from matd3_jax.envs.robots.quiet import quiet_mujoco

# Of gymnasium's half_cheetah.xml.
pytestmark = pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'")

IDS = {
    "ant": "Ant-v5",
    "half_cheetah": "HalfCheetah-v5",
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
    "humanoid": "Humanoid-v5",
    "swimmer": "Swimmer-v5",
}
BATCH = 120


def theirs(name):
    """gymnasium's environment, without the compiler's warnings, which it would log in the working directory."""
    with quiet_mujoco():
        return gymnasium.make(IDS[name]).unwrapped


def progress(name, model, data):
    """What the forward reward is the speed of, as the data have it."""
    if name == "ant":
        return data.body("torso").xpos[0]
    return model.body_mass @ data.xipos[:, 0] / model.body_mass.sum() if name == "humanoid" else data.qpos[0]


@functools.cache
def play(name, newton):
    """Columns [BATCH, ...] of steps that gymnasium makes: state before, action, and what came of it.

    newton: with Newton's solver, whatever the model asks for.
    """
    env = theirs(name)
    model, data = env.model, env.data
    model.geom_margin /= 2  # as MuJoCo had margins before 3.5.0; here and in our model
    if newton:
        model.opt.solver, model.opt.iterations = mujoco.mjtSolver.mjSOL_NEWTON, 100
    rng, rows, steps = np.random.default_rng(0), [], 0
    env.reset(seed=0)
    while len(rows) < BATCH:
        if model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
            data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        before = data.qpos.copy(), data.qvel.copy(), progress(name, model, data)
        if steps % 10 < 5:
            action = rng.uniform(*model.actuator_ctrlrange.T).astype(np.float32)
        observation, reward, terminated, _, info = env.step(action)
        terms = [info.get(f"reward_{term}", 0.0) for term in ("forward", "survive", "ctrl", "contact")]
        rows.append((*before, action, observation, reward, terminated, terms, data.qpos.copy(), data.qvel.copy()))
        steps += 1
        if steps > 60 or (terminated and steps > 30):
            env.reset()
            steps = 0
    return [np.array(column) for column in zip(*rows, strict=True)]


BOUNDS = {
    # Measured, the worst of all robots: positions 6e-8, 1.9e-7, 2.6e-7; velocities 1e-6, 4e-6, 1.8e-5; observations
    # 5e-7, 6e-6, 1.8e-5; terms of the reward 2.5e-6: the state's rounding to float32. Two to three times that, five
    # times the maxima.
    "c": {
        "qpos": (1.5e-7, 4e-7, 1.3e-6),
        "qvel": (3e-6, 1e-5, 9e-5),
        "observation": (1.5e-6, 1.5e-5, 9e-5),
        "terms": 1e-5,
    },
    # Measured, the worst of all robots: positions 1e-7, 8e-7, 3e-6; velocities 1e-5, 6e-5, 4e-4; observations 2e-6,
    # 3e-5, 5e-4 (humanoid 5e-6, 1e-4, 5e-3); terms 6e-5.
    "mjx": {"qpos": (5e-7, 2e-6, 1e-5), "qvel": (3e-5, 2e-4, 1e-3), "observation": (5e-6, 1e-4, 2e-3), "terms": 1e-4},
}
"""Of median, 95 % quantile and maximum; observations relative to 1 + the entry's size, as forces and inertias are
large."""


def cases():
    """Every robot with every engine; MJX compiles for long, so that one of them stands for the others."""
    for physics in BOUNDS:
        for name in IDS:
            slow = physics == "mjx" and name != "swimmer"
            yield pytest.param(name, physics, marks=[pytest.mark.slow] * slow, id=f"{physics}-{name}")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "physics"), [*cases()])
def test_steps_are_those_of_gymnasium(name, physics):
    env = make(name, physics=physics, split="single")
    # The humanoid's model asks for PGS, which MJX lacks.
    newton = name == "humanoid" and physics == "mjx"
    qpos, qvel, x, action, observation, reward, terminated, terms, next_qpos, next_qvel = play(name, newton)

    @jax.jit
    @jax.vmap
    def step(qpos, qvel, x, action):
        return env.step(None, env.state(qpos, qvel)._replace(progress=x), (action,))

    found = jax.device_get(step(*(jnp.asarray(part, jnp.float32) for part in (qpos, qvel, x, action))))
    full = found.observation[0]
    if name == "ant":  # as in Ant-v2, where Ant-v5 leaves the world body out
        assert (full[:, 27:33] == 0).all()
        full = np.delete(full, np.s_[27:33], axis=1)
    assert full.shape == observation.shape

    def quantiles(error):
        return np.quantile(np.abs(error).max(axis=1), [0.5, 0.95, 1])

    bounds = BOUNDS[physics]
    errors = {
        "qpos": found.state.qpos - next_qpos,
        "qvel": found.state.qvel - next_qvel,
        "observation": (full - observation) / (1 + np.abs(observation)),
    }
    for part, error in errors.items():
        bound = np.array(bounds[part]) * (5 if (name, part, physics) == ("humanoid", "observation", "mjx") else 1)
        assert (quantiles(error) < bound).all(), (part, quantiles(error))
    np.testing.assert_array_equal(found.terminated, terminated)
    if name == "ant":  # Ant-v2 pays the bonus on the terminal step, too
        terms, reward = terms.copy(), reward + terminated
        terms[:, 1] = 1
    np.testing.assert_allclose(found.state.terms, terms, rtol=0, atol=bounds["terms"])
    np.testing.assert_allclose(found.reward[:, 0], reward, rtol=1e-6, atol=bounds["terms"])


# Only the humanoid's reset asks the engine.
@pytest.mark.slow
@pytest.mark.parametrize(("name", "physics"), [*((name, "c") for name in IDS), ("humanoid", "mjx")])
def test_reset_is_gymnasiums(name, physics):
    env, other = make(name, physics=physics, split="single"), theirs(name)
    wanted = np.stack([other.reset(seed=seed)[0] for seed in range(300)])
    if name == "ant":
        wanted = np.insert(wanted, [27] * 6, 0.0, axis=1)
    if env.mj_model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        wanted[:, 1:5] /= np.linalg.norm(wanted[:, 1:5], axis=1, keepdims=True)  # MuJoCo does it at the first step
    found = np.asarray(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 300))[1][0])
    assert found.shape == wanted.shape
    # Two samples of 300: means apart by less than five standard errors, spreads by less than a fifth.
    error, rounding = np.sqrt(wanted.var(axis=0) / 150), 1e-5 * (1 + np.abs(wanted).max(axis=0))
    assert (np.abs(found.mean(axis=0) - wanted.mean(axis=0)) <= 5 * error + rounding).all()
    spread = wanted.std(axis=0) > rounding
    ratio = found.std(axis=0)[spread] / wanted.std(axis=0)[spread]
    assert ((ratio > 0.8) & (ratio < 1.25)).all(), ratio
