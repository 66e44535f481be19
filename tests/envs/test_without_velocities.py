"""Robots without velocities: what is observed is what is observed with them, less the velocities.

Where velocities are is read off MuJoCo's own layout: gymnasium's observation is qpos without the first entries, all nv
entries of qvel, then of the humanoid 10 numbers of inertia and 6 of velocity for each of 13 bodies, and forces.
"""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from matd3_jax.envs import make
from matd3_jax.envs.wrappers.joint_team import JointTeam

HIDDEN = {"ant": 2, "half_cheetah": 1, "hopper": 1, "walker2d": 1, "humanoid": 2, "swimmer": 2}
"""Positions along the ground, which gymnasium leaves out."""
ARMS = ["left_elbow", "left_shoulder1", "left_shoulder2", "right_elbow", "right_shoulder1", "right_shoulder2"]
REST = [
    *(f"abdomen_{axis}" for axis in "xyz"), *(f"{side}_hip_{axis}" for side in ("left", "right") for axis in "xyz"),
    "left_knee", "right_knee",
]  # fmt: skip
CASES = [
    # robot, split, depth, entries of each agent
    ("ant", "halves", None, (49, 49)),
    ("ant", "4x2", 2, (37, 37, 37, 37)),
    ("ant", "single", None, (97,)),
    ("half_cheetah", "2x3", None, (6, 6)),
    ("half_cheetah", "6x1", 0, (3,) * 6),
    ("hopper", "3x1", None, (4, 5, 4)),
    ("walker2d", "2x3", 2, (7, 7)),
    ("humanoid", "9|8", None, (173, 120)),
    ("humanoid", [ARMS, REST], None, (92, 161)),
    ("swimmer", "2x1", None, (3, 3)),
    ("swimmer", "2x1", 0, (2, 2)),
]


def moving(robot, model):
    """Entries of gymnasium's observation that are velocities."""
    first = model.nq - HIDDEN[robot]
    found = set(range(first, first + model.nv))
    if robot == "humanoid":
        bodies = model.nbody - 1
        found |= set(range(first + model.nv + 10 * bodies, first + model.nv + 16 * bodies))
    return found


def pair(robot, split, depth, **options):
    """(With velocities, without.)"""
    both = {"split": split, "depth": depth, **options}
    return make(robot, **both), make(robot, **both, velocities=False)


def sample(env, key):
    return tuple(space.sample(jax.random.fold_in(key, i)) for i, space in enumerate(env.action_spaces))


@pytest.mark.slow
@pytest.mark.parametrize(("robot", "split", "depth", "sizes"), CASES, ids=lambda part: str(part)[:12])
def test_observations_are_the_usual_ones_less_the_velocities(robot, split, depth, sizes):
    usual, env = pair(robot, split, depth, physics="c")
    assert env.observation_sizes == sizes and env.agents == usual.agents
    gone = moving(robot, env.mj_model)
    whole = [i for i in range(usual.full_observation_size) if i not in gone]
    own = [[i for i in entries if i not in gone] for entries in usual.partition.observations]
    assert env.full_observation_size == len(whole)
    assert [[whole[i] for i in entries] for entries in env.entries_in_full_observation] == own
    assert env.partition.actuators == usual.partition.actuators

    def play(env):
        """Three env steps: (states, full observations, observations, rewards, ends)."""
        state, observation = env.reset(jax.random.key(4))
        found = [(state, env.full_observation(state), observation, jnp.zeros(len(env.agents)), jnp.zeros(2, bool))]
        for k in range(3):
            after = env.step(None, state, sample(usual, jax.random.key(k)))
            state, ends = after.state, jnp.stack([after.terminated, after.truncated])
            found.append((state, env.full_observation(state), after.observation, after.reward, ends))
        return found

    for found, wanted in zip(jax.jit(play, static_argnums=0)(env), jax.jit(play, static_argnums=0)(usual), strict=True):
        (state, full, observation, reward, ends), (other, all_, seen, pay, over) = found, wanted
        np.testing.assert_array_equal(state.qpos, other.qpos)
        np.testing.assert_array_equal(state.qvel, other.qvel)
        np.testing.assert_array_equal(full, all_[np.array(whole)])
        for a, b, entries in zip(observation, seen, usual.partition.observations, strict=True):
            kept = [k for k, i in enumerate(entries) if i not in gone]
            np.testing.assert_array_equal(a, b[np.array(kept)])
        np.testing.assert_array_equal(reward, pay)
        np.testing.assert_array_equal(ends, over)
        # What is gone is what MuJoCo calls velocities, in the model that gymnasium's file makes.
        first = env.mj_model.nq - HIDDEN[robot]
        clipped = np.clip(other.qvel, -10, 10) if robot in ("hopper", "walker2d") else other.qvel
        np.testing.assert_array_equal(all_[first : first + env.mj_model.nv], clipped)

    if robot == "humanoid":
        start, data = jax.jit(usual.reset)(jax.random.key(4))[0], mujoco.MjData(env.mj_model)
        data.qpos[:], data.qvel[:] = start.qpos, start.qvel
        mujoco.mj_forward(env.mj_model, data)
        full = np.asarray(usual.full_observation(start))
        np.testing.assert_allclose(full[sorted(gone)[env.mj_model.nv :]], data.cvel[1:].ravel(), atol=1e-6)


@pytest.mark.parametrize("robot", HIDDEN)
def test_nothing_that_is_left_says_how_fast_the_robot_is(robot):
    """The same positions with any velocities look the same, and other positions do not."""
    usual, env = (make(robot, physics="c", velocities=velocities) for velocities in (True, False))
    model = env.mj_model
    rng = np.random.default_rng(0)
    qpos = np.asarray(model.qpos0 + rng.uniform(-0.1, 0.1, model.nq), np.float32)
    fast, slow = np.asarray(rng.normal(0, 1, (2, model.nv)), np.float32)
    for one, alike in ((env, True), (usual, False)):
        observe = jax.jit(lambda qpos, qvel, one=one: one.observe(one.state(qpos, qvel)))
        for a, b, c in zip(observe(qpos, fast), observe(qpos, slow), observe(qpos + 0.1, fast), strict=True):
            assert (np.asarray(a) == np.asarray(b)).all() == alike
            assert (np.asarray(a) != np.asarray(c)).any()
    # The force of a motor is its control times a constant: it has no part that hangs on velocities.
    assert (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED).all()
    assert (model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE).all()
    assert (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE).all()


@pytest.mark.parametrize("physics", ["mjx", "mjx_fast"])
@pytest.mark.parametrize("robot", ["humanoid", "swimmer"])
def test_the_other_engines_have_the_same_entries(robot, physics):
    """Shapes alone: MJX compiles for long, and what is observed of a state is no matter of the engine."""
    _, env = pair(robot, "9|8" if robot == "humanoid" else "2x1", None, physics=physics)
    c = make(robot, physics="c", velocities=False)
    assert env.partition == c.partition
    state, observation = jax.eval_shape(env.reset, jax.random.key(0))
    assert [x.shape for x in jax.tree.leaves(state)] == [
        x.shape for x in jax.tree.leaves(jax.eval_shape(c.reset, jax.random.key(0))[0])
    ]
    assert tuple(x.shape[0] for x in observation) == env.observation_sizes
    if robot == "swimmer":
        after = jax.eval_shape(env.step, jax.random.key(0), state, sample(env, jax.random.key(0)))
        assert tuple(x.shape[0] for x in after.observation) == env.observation_sizes
        assert jax.tree.structure(after.state) == jax.tree.structure(state)


@pytest.mark.slow
def test_mjx_observes_what_c_does():
    """One env step of the swimmer, to float32's rounding."""
    found = []
    for physics in ("c", "mjx"):
        env = make("swimmer", physics=physics, velocities=False)
        state, _ = jax.jit(env.reset)(jax.random.key(0))
        after = jax.jit(env.step)(None, state, tuple(jnp.full(1, 0.5) for _ in env.agents))
        found.append(np.concatenate(after.observation))
    np.testing.assert_allclose(*found, atol=1e-5)


def test_names_are_the_usual_ones_less_those_of_velocities():
    for robot in HIDDEN:
        usual, env = (make(robot, physics="c", velocities=velocities) for velocities in (True, False))
        for name in ("full_observation_names", "observation_names"):
            a, b = getattr(env, name), getattr(usual, name)
            each = [(a, b)] if name.startswith("full") else zip(a, b, strict=True)
            for found, wanted in each:
                assert list(found) == [text for text in wanted if "velocity" not in text]
        assert [len(names) for names in env.observation_names] == list(env.observation_sizes)
        assert all(itertools.chain(env.full_observation_names, *env.observation_names))


def test_one_agent_in_everybody_s_place_sees_no_velocities_either():
    for robot, size in (("ant", 97), ("half_cheetah", 8), ("hopper", 5), ("humanoid", 247)):
        env = make(robot, physics="c", velocities=False)
        joint = JointTeam(env)
        state, (seen,) = jax.jit(joint.reset)(jax.random.key(0))
        assert joint.observation_sizes == (size,) == seen.shape == (len(joint.observation_names[0]),)
        np.testing.assert_array_equal(seen, env.full_observation(state))
