"""brax's robots under this project's contract, against brax's own environments and MuJoCo's kinematics."""

import json
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from matd3_jax import config
from matd3_jax.envs import Box, OptionError, make, names
from matd3_jax.envs.robots import brax_models as models
from matd3_jax.envs.robots.brax import BraxState
from matd3_jax.envs.robots.quiet import quiet, quiet_mujoco
from matd3_jax.envs.wrappers.joint_team import JointTeam

ROBOTS = {  # name -> brax's name, size of its observation, controls
    "ant": ("ant", 27, 8),
    "half_cheetah": ("halfcheetah", 17, 6),
    "hopper": ("hopper", 11, 3),
    "walker2d": ("walker2d", 17, 6),
    "humanoid": ("humanoid", 244, 17),
    "swimmer": ("swimmer", 8, 2),
}
REWARDS = {  # the metric of brax's that has each part of the reward
    "ant": ("reward_forward", "reward_survive", "reward_ctrl"),
    "half_cheetah": ("reward_run", "reward_ctrl"),
    "hopper": ("reward_forward", "reward_healthy", "reward_ctrl"),
    "walker2d": ("reward_forward", "reward_healthy", "reward_ctrl"),
    "humanoid": ("reward_linvel", "reward_alive", "reward_quadctrl"),
    "swimmer": ("reward_fwd", "reward_ctrl"),
}
LEGS = [["hip_4", "ankle_4", "hip_2"], ["ankle_1", "hip_3", "ankle_3", "hip_1", "ankle_2"]]


def brax_env(robot, backend):
    """brax's own environment, made again."""
    import brax.envs

    with quiet(), quiet_mujoco():
        return brax.envs.get_environment(ROBOTS[robot][0], backend=backend)


def control_of(env, action):
    """What the robot's motors get, joint by joint from the model's names."""
    control = np.full(env.mj_model.nu, np.nan, np.float32)
    renamed = {"motor1_rot": "rot2", "motor2_rot": "rot3"} if env.robot == "swimmer" else {}
    motor = {env.mj_model.joint(j).name: i for i, j in enumerate(env.mj_model.actuator_trnid[:, 0])}
    for joints, values in zip(env.partition.joints, action, strict=True):
        for joint, value in zip(joints, values, strict=True):
            control[motor[renamed.get(joint, joint)]] = value
    return control


def random_action(env, rng):
    return tuple(rng.uniform(-1, 1, space.size).astype(np.float32) for space in env.action_spaces)


@pytest.mark.slow
@pytest.mark.parametrize("robot", [pytest.param(r, marks=[pytest.mark.slow] * (r != "ant")) for r in ROBOTS])
def test_steps_are_brax_s_own(robot):
    """Reset and three steps with the same key and actions, in one program, so that nothing but our part can differ."""
    split = {"split": LEGS} if robot == "ant" else {}
    env = make(f"brax_{robot}", **split)
    theirs = brax_env(robot, env.backend)
    rng = np.random.default_rng(0)
    actions = [random_action(env, rng) for _ in range(3)]
    controls = np.array([control_of(env, action) for action in actions])
    assert not np.isnan(controls).any()

    def both(key, actions, controls):
        with models.calling():
            brax_start = theirs.reset(key)
        start, observation = env.reset(key)

        def step(carry, inputs):
            (brax_state, state), (action, control) = carry, inputs
            with models.calling():
                brax_state = theirs.step(brax_state, control)
            ts = env.step(None, state, action)
            brax_state = jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), brax_state, brax_start)
            return (brax_state, ts.state), (brax_state, ts, env.full_observation(ts.state), env.measure(ts.state))

        return brax_start, start, observation, jax.lax.scan(step, (brax_start, start), (actions, controls))[1]

    stacked = tuple(map(np.stack, zip(*actions, strict=True)))
    brax_start, start, observation, (after, ts, full, measured) = jax.device_get(
        jax.jit(both)(jax.random.key(3), stacked, controls)
    )
    n = len(env.agents)
    np.testing.assert_array_equal(start.full_observation, brax_start.obs)
    np.testing.assert_allclose(full, after.obs, rtol=1e-5, atol=1e-5)
    assert (env.full_observation_size, sum(space.size for space in env.action_spaces)) == ROBOTS[robot][1:]
    for agent, indices in enumerate(env.partition.observations):
        np.testing.assert_array_equal(observation[agent], start.full_observation[list(indices)])
        np.testing.assert_array_equal(ts.observation[agent], full[:, list(indices)])
        assert ts.observation[agent].shape == (3, env.observation_sizes[agent])
    np.testing.assert_allclose(ts.reward, np.tile(after.reward[:, None], n), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(ts.terminated, after.done > 0)
    assert not ts.truncated.any() and ts.state.step.tolist() == [1, 2, 3]
    expected = [after.metrics[name] for name in ("x_velocity", *REWARDS[robot])]
    np.testing.assert_allclose(measured, np.stack(expected, axis=1), rtol=1e-4, atol=1e-4)
    # The parts are all there is to brax's rewards.
    np.testing.assert_allclose(measured[:, 1:].sum(axis=1), after.reward, rtol=1e-4, atol=1e-4)
    assert env.measures[:2] == ("forward_velocity", "reward_forward") and env.measures[-1] == "reward_ctrl"
    assert ("reward_survive" in env.measures) == (len(REWARDS[robot]) == 3)
    assert np.abs(measured[:, 0]).min() > 1e-4  # it does move


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in names() if name.startswith("brax_")])
def test_state_keeps_its_types(name):
    """A weak type or another dtype would compile the step twice, and break scans."""
    env = make(name)
    key = jax.random.key(0)
    actions = tuple(jnp.zeros(space.shape) for space in env.action_spaces)
    state, observation = jax.eval_shape(env.reset, key)
    after = jax.eval_shape(env.step, key, state, actions)

    def types(tree):
        return jax.tree.map(lambda x: (x.shape, x.dtype, getattr(x, "weak_type", False)), tree)

    assert types(state) == types(after.state) and types(observation) == types(after.observation)
    assert not any(x.weak_type for x in jax.tree.leaves((state, after)))
    assert after.reward.shape == (len(env.agents),) and after.reward.dtype == jnp.float32
    assert after.terminated.dtype == after.truncated.dtype == bool


@pytest.mark.parametrize("backend", ["positional", "generalized"])
def test_other_backends_trace(backend):
    env = make("brax_ant", backend=backend)
    state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, None, state, (jnp.zeros(4), jnp.zeros(4)))
    assert jax.tree.structure(state) == jax.tree.structure(after.state)
    assert type(state.pipeline).__module__ == f"brax.{backend}.base"


def test_no_matrix_product_of_the_physics_is_left_at_a_gpu_s_default_precision():
    env = make("brax_ant")
    state, _ = jax.eval_shape(env.reset, jax.random.key(0))
    for program in (
        jax.make_jaxpr(env.reset)(jax.random.key(0)),
        jax.make_jaxpr(env.step)(None, state, (jnp.zeros(4), jnp.zeros(4))),
    ):
        lines = [line for line in str(program).splitlines() if "precision=" in line]
        assert lines and all("HIGHEST" in line for line in lines)


@pytest.fixture(scope="module")
def ant():
    """brax_ant with the spring backend, and its compiled step for a batch."""
    env = make("brax_ant")
    return env, jax.jit(jax.vmap(env.step, (None, 0, 0)))


class TestAnt:
    def test_ends_of_episodes(self, ant):
        """Batched: standing; too high; at the time limit; broken; blown up; broken and at the time limit."""
        env, step = ant
        theirs = brax_env("ant", "spring")
        start = jax.jit(theirs.pipeline_init)

        def state(z):
            """At rest at height z (m)."""
            pipeline = start(jnp.asarray(theirs.sys.init_q).at[2].set(z), jnp.zeros(14))
            return BraxState(pipeline, jnp.zeros(27), jnp.zeros(4), jnp.int32(0))

        good, high = state(0.6), state(1.5)
        last = good._replace(step=jnp.int32(999))
        broken = good._replace(pipeline=jax.tree.map(lambda x: x * jnp.nan, good.pipeline))
        fast = good._replace(
            pipeline=good.pipeline.replace(
                xd_i=good.pipeline.xd_i.replace(vel=good.pipeline.xd_i.vel + jnp.array([1e7, 0, 0]))
            )
        )
        both = broken._replace(step=jnp.int32(999))
        states = jax.tree.map(lambda *x: jnp.stack(x), good, high, last, broken, fast, both)
        ts = step(None, states, (jnp.zeros((6, 4)), jnp.zeros((6, 4))))
        assert ts.terminated.tolist() == [False, True, False, True, True, True]
        assert ts.truncated.tolist() == [False, False, True, False, False, True]
        assert ts.state.step.tolist() == [1, 1, 1000, 1, 1, 1000]
        # Small enough for squares of squares, too.
        assert all((np.abs(x) <= 1e5).all() for x in jax.tree.leaves((ts.observation, ts.reward, ts.state.measured)))
        rewards = np.asarray(ts.reward)
        assert (rewards[:, 0] == rewards[:, 1]).all()
        assert (rewards[3:] == 0).all()
        # The bonus for being alive is paid on the step that ends it, too, as brax does.
        np.testing.assert_allclose(rewards[:3, 0], 1, atol=0.02)

    def test_environments_of_a_batch_do_not_touch_each_other(self, ant):
        env, step = ant
        rng = np.random.default_rng(1)
        states, _ = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 6))
        actions = tuple(rng.uniform(-1, 1, (6, 4)).astype(np.float32) for _ in range(2))
        order = np.array([3, 0, 5, 5, 1, 4])
        ts = step(None, states, actions)
        permuted = step(None, *jax.tree.map(lambda x: x[order], (states, actions)))
        for x, y in zip(jax.tree.leaves(ts), jax.tree.leaves(permuted), strict=True):
            np.testing.assert_array_equal(np.asarray(x)[order], y)
        assert len(np.unique(ts.reward[:, 0])) == 6

    def test_halves_see_what_the_paper_lists_as_far_as_brax_shows_it(self, ant):
        env, _ = ant
        recorded = json.loads((pathlib.Path(__file__).parents[1] / "data/ant/index_maps.json").read_text())
        paper = next(value for key, value in recorded.items() if key.startswith("paper_split_obs_59"))
        halves = next(value for key, value in paper.items() if key.startswith("y-halves"))
        assert [list(own) for own in env.partition.observations] == [[i for i in own if i < 27] for own in halves]
        assert env.agents == ("agent_0", "agent_1") and env.observation_sizes == (23, 23)
        assert env.action_spaces == (Box(4, -1.0, 1.0),) * 2
        assert sum(env.return_weights) == 1 and env.episode_length == 1000
        assert env.agent_bodies == ((2, 3, 4, 5, 6, 7), (8, 9, 10, 11, 12, 13))

    def test_as_one_agent(self, ant):
        env, _ = ant
        joined, single = JointTeam(env), make("brax_ant", split="single")
        assert joined.observation_sizes == single.observation_sizes == (27,)
        assert joined.action_spaces == single.action_spaces == (Box(8, -1.0, 1.0),)
        assert joined.measures == env.measures


@pytest.mark.parametrize("robot", ["half_cheetah", "swimmer"])
def test_positions_are_those_of_the_model_to_draw(robot):
    """MuJoCo puts every body where brax has it. (On the move, spring's joints give way by centimetres.)"""
    env = make(f"brax_{robot}")
    state, _ = jax.jit(env.reset)(jax.random.key(0))
    data = mujoco.MjData(env.mj_model)
    data.qpos[:] = env.qpos(state)
    mujoco.mj_kinematics(env.mj_model, data)
    np.testing.assert_allclose(data.xpos[1:], state.pipeline.x.pos, atol=1e-5)
    assert np.abs(data.xpos[1:]).max() > 0.1


def test_humanoid_s_bodies_are_brax_s_links():
    """brax fuses the feet with the shins, so that its links are not numbered as the model's bodies are."""
    env = make("brax_humanoid")
    layout, model, links = models.layout("humanoid"), env.mj_model, brax_env("humanoid", "spring").sys.link_names
    assert len(links) == 11 and model.nbody == 14 and layout.size == 244
    for body in range(1, model.nbody):
        name = model.body(body).name
        if name in links:
            index = links.index(name)
            assert layout.entry("cinert", body) == tuple(range(45 + 10 * index, 55 + 10 * index))
            assert layout.entry("cvel", body) == tuple(range(155 + 6 * index, 161 + 6 * index))
        else:
            assert name in ("right_foot", "left_foot")
            assert layout.entry("cinert", body) == layout.entry("cvel", body) == ()
    assert layout.entry("qfrc_actuator", 0) == (221,) and layout.entry("qfrc_actuator", 22) == (243,)


@pytest.mark.parametrize("robot", ROBOTS)
def test_without_velocities(robot):
    """Of what brax shows, each entry known by its number: all but MuJoCo's nv and six for each link of the humanoid."""
    usual, env = make(f"brax_{robot}"), make(f"brax_{robot}", velocities=False)
    model, size = env.mj_model, ROBOTS[robot][1]
    first = model.nq - models.FACTS[robot].hidden
    gone = {*range(first, first + model.nv)} | ({*range(155, 221)} if robot == "humanoid" else set())
    state = BraxState(None, jnp.arange(size), jnp.zeros(0), jnp.int32(0))
    whole = [i for i in range(size) if i not in gone]
    assert env.full_observation(state).tolist() == whole and env.full_observation_size == len(whole)
    for a, b, many in zip(env.observe(state), usual.observe(state), env.observation_sizes, strict=True):
        assert a.tolist() == [i for i in b.tolist() if i not in gone] and len(a) == many < len(b)
    assert all("velocity" not in name for name in env.full_observation_names)
    wanted = [name for name in usual.full_observation_names if "velocity" not in name]
    assert list(env.full_observation_names) == wanted


def test_steps_without_velocities():
    usual, env = make("brax_hopper"), make("brax_hopper", velocities=False)
    state, start = jax.jit(env.reset)(jax.random.key(0))
    after = jax.jit(lambda state: env.step(None, state, tuple(jnp.ones(1) for _ in env.agents)))(state)
    for state_, seen in ((state, start), (after.state, after.observation)):
        full = usual.full_observation(state_)
        assert full.shape == (11,)
        np.testing.assert_array_equal(env.full_observation(state_), full[:5])
        for own, entries in zip(seen, env.partition.observations, strict=True):
            np.testing.assert_array_equal(own, full[np.array(entries)])


def test_first_use_within_a_trace_leaves_nothing_of_it_behind():
    models.load.cache_clear()
    jax.eval_shape(lambda key: make("brax_hopper").reset(key), jax.random.key(0))
    with jax.check_tracer_leaks():
        state, _ = jax.eval_shape(make("brax_hopper").reset, jax.random.key(0))
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(models.load("hopper", "spring").sys.link))
    assert state.full_observation.shape == (11,)


def test_equal_options_are_equal_environments():
    lists = make("brax_ant", split=LEGS)
    assert lists == make("brax_ant", split=tuple(map(tuple, LEGS))) and len({lists, make("brax_ant")}) == 2
    assert make("brax_ant", backend="positional") != make("brax_ant")


def test_partitions_can_be_written_on_the_command_line():
    for split, agents in ((LEGS, 2), ("4x2", 4), ("single", 1)):
        written = str(split).replace("'", "")
        options = dict(config.load(["env=brax_ant", f"env.split={written}", "env.backend=positional"]).env)
        env = make(options.pop("name"), **options)
        assert env == make("brax_ant", split=split, backend="positional") and len(env.agents) == agents


@pytest.mark.slow
def test_nothing_is_printed_or_logged(tmp_path):
    """Neither brax's and MJX's remarks, nor what MuJoCo's compiler says about half_cheetah's file."""
    code = "from matd3_jax.envs import make; make('brax_half_cheetah').mj_model"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert out.stdout == out.stderr == "" and not list(tmp_path.iterdir())


def test_brax_is_not_there(monkeypatch):
    monkeypatch.setitem(sys.modules, "brax", None)
    with pytest.raises(OptionError, match="pip install brax"):
        make("brax_ant")


@pytest.mark.parametrize(
    ("name", "given", "words"),
    [
        ("brax_ant", {"backend": "mjx"}, ["backend='mjx'", "'spring', 'positional', 'generalized'"]),
        ("brax_ant", {"backend": None}, ["backend=None", "'spring'"]),
        ("brax_swimmer", {"backend": "spring"}, ["backend='spring'", "'generalized'"]),
        ("brax_hopper", {"split": "halves"}, ["split='halves'", "hopper", "3x1"]),
        ("brax_ant", {"split": [["hip_1", "ankle_1"]]}, ["'hip_2'", "no agent"]),
        ("brax_ant", {"split": 4}, ["split=4", "joint names"]),
        ("brax_ant", {"depth": -1}, ["depth=-1", "at least 0"]),
        ("brax_ant", {"split": "4x2", "depth": True}, ["depth=True", "integer"]),
        ("brax_ant", {"velocities": 1}, ["velocities=1", "true or false"]),
        ("brax_ant", {"episode_length": 0}, ["episode_length=0", "at least 1"]),
        ("brax_ants", {}, ["'brax_ants'", "did you mean 'brax_ant'"]),
        ("brax_ant", {"dept": 1}, ["'dept'", "did you mean 'depth'"]),
    ],
)
def test_refusals(name, given, words):
    make("brax_ant", split="4x2", depth=1)  # equal to True, not the same
    with pytest.raises(OptionError) as error:
        make(name, **given)
    for word in words:
        assert word in str(error.value)
    assert "\n" not in str(error.value)
