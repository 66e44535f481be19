"""Partitions of robots among agents, against recorded index lists and against the installed MaMuJoCo."""

import contextlib
import dataclasses
import json
import pathlib

import gymnasium
import mujoco
import numpy as np
import pytest

from matd3_jax.envs import OptionError
from matd3_jax.envs.robots.partition.graphs import GRAPHS
from matd3_jax.envs.robots.partition.partition import default_split, describe, lay_out, partition

RECORDED = json.loads((pathlib.Path(__file__).parents[1] / "data/ant/index_maps.json").read_text())
PAPER = next(RECORDED[key] for key in RECORDED if key.startswith("paper_split_obs_59"))
PAPER_ACTIONS = next(RECORDED[key] for key in RECORDED if key.startswith("paper_split_actions"))
MAMUJOCO_ANT = next(RECORDED[key] for key in RECORDED if key.startswith("mamujoco_v1"))

FILES = {robot: f"{robot}.xml" for robot in GRAPHS} | {"walker2d": "walker2d_v5.xml"}
SCENARIOS = {
    "ant": "Ant",
    "half_cheetah": "HalfCheetah",
    "hopper": "Hopper",
    "walker2d": "Walker2d",
    "humanoid": "Humanoid",
    "swimmer": "Swimmer",
}
MAMUJOCO_SPLITS = [(robot, split) for robot in GRAPHS for split in GRAPHS[robot].splits if split != "halves"]

ANT_V2 = lay_out(15, 14, hidden=2, cfrc_ext=range(14))
ANT_V5 = lay_out(15, 14, hidden=2, cfrc_ext=range(1, 14))
LAYOUTS = {
    "ant": ANT_V5,
    "half_cheetah": lay_out(9, 9, hidden=1),
    "hopper": lay_out(6, 6, hidden=1),
    "walker2d": lay_out(9, 9, hidden=1),
    "humanoid": lay_out(
        24, 23, hidden=2, cinert=range(1, 14), cvel=range(1, 14), qfrc_actuator=range(6, 23), cfrc_ext=range(1, 14)
    ),
    "swimmer": lay_out(5, 5, hidden=2),
}


@contextlib.contextmanager
def quiet():
    """MuJoCo prints, and logs in the working directory, that half_cheetah's `settotalmass` is deprecated."""
    mujoco.set_mju_user_warning(lambda message: None)
    yield
    mujoco.set_mju_user_warning(None)


def tree_of(robot):
    assets = pathlib.Path(gymnasium.__file__).parent / "envs/mujoco/assets"
    with quiet():
        return describe(mujoco.MjModel.from_xml_path(str(assets / FILES[robot])))


TREES = {robot: tree_of(robot) for robot in GRAPHS}
LEGS = [(f"hip_{leg}", f"ankle_{leg}") for leg in (1, 2, 3, 4)]


def split_ant(split, depth=None, layout=ANT_V2):
    return partition("ant", TREES["ant"], layout, split, depth)


def test_layouts_are_as_long_as_gymnasium_s_observations():
    sizes = {robot: layout.size for robot, layout in LAYOUTS.items()}
    assert sizes == {"ant": 105, "half_cheetah": 17, "hopper": 11, "walker2d": 17, "humanoid": 348, "swimmer": 8}
    assert ANT_V2.size == 111
    assert ANT_V2.entry("qpos", 1) == () and ANT_V2.entry("qpos", 2) == (0,) and ANT_V2.entry("cinert", 3) == ()
    assert ANT_V2.entry("cfrc_ext", 0) == tuple(range(27, 33)) and ANT_V5.entry("cfrc_ext", 0) == ()


@pytest.mark.parametrize(
    ("split", "recorded"),
    [
        ("halves", "y-halves"),
        ([LEGS[0] + LEGS[1], LEGS[2] + LEGS[3]], "y-halves"),
        ([list(LEGS[0] + LEGS[3]), list(LEGS[1] + LEGS[2])], "x-halves"),
        ([LEGS[0] + LEGS[2], LEGS[1] + LEGS[3]], "by XML names"),
    ],
)
def test_the_paper_s_observation_of_the_ant(split, recorded):
    (key,) = (key for key in PAPER if key.startswith(recorded))
    result = split_ant(split)
    assert [list(indices) for indices in result.observations] == PAPER[key]
    assert [list(indices) for indices in result.actuators] == PAPER_ACTIONS[key]
    assert result.agents == ("agent_0", "agent_1")


def test_halves_are_the_left_and_the_right_of_the_walking_direction():
    """+x is forward, so left is y > 0; and each half is drawn in one color, thighs that are welded on included."""
    result = split_ant("halves")
    legs = RECORDED["legs"]
    for agent, numbers, side in ((0, "12", "+y"), (1, "34", "-y")):
        assert all(legs[n]["xy_quadrant"].endswith(side) for n in numbers)
        assert result.joints[agent] == tuple(f"{joint}_{n}" for n in numbers for joint in ("hip", "ankle"))
        assert result.bodies[agent] == tuple(body for n in numbers for body in legs[n]["bodies"])


@pytest.mark.parametrize("key", MAMUJOCO_ANT)
def test_recorded_indices_of_mamujoco_s_ant(key):
    split, depth = key.split(" obsk=")
    result = split_ant(split, int(depth), ANT_V5)
    for i, agent in enumerate(result.agents):
        assert list(result.observations[i]) == MAMUJOCO_ANT[key][agent]["obs"]
        assert list(result.actuators[i]) == MAMUJOCO_ANT[key][agent]["act"]
    # The same in Ant-v2's observation, which shows the world's force (6 zeros) before the torso's.
    for v2, v5 in zip(split_ant(split, int(depth)).observations, result.observations, strict=True):
        assert list(v2) == [i if i < 27 else i + 6 for i in v5]


@pytest.fixture(scope="module")
def mamujoco():
    from gymnasium_robotics.envs.multiagent_mujoco import mujoco_multi  # slow to import

    made = {}

    def make(robot, split, depth):
        if (robot, split, depth) not in made:
            made[robot, split, depth] = mujoco_multi.MultiAgentMujocoEnv(SCENARIOS[robot], split, agent_obsk=depth)
        return made[robot, split, depth]

    with quiet():
        yield make
    for env in made.values():
        env.close()


def put_in_random_state(env, rng, speed):
    """Anywhere near the start, fast, with random torques and (where there are any) contact forces at work."""
    robot = env.single_agent_env.unwrapped
    data = robot.data
    data.ctrl[:] = rng.uniform(*robot.action_space.low[:1], *robot.action_space.high[:1], data.ctrl.shape)
    robot.set_state(
        robot.init_qpos + rng.uniform(-0.3, 0.3, data.qpos.shape), rng.uniform(-speed, speed, data.qvel.shape)
    )
    # As random as the rest, whether or not something touches: an entry seen twice or missed cannot hide among zeros.
    data.cfrc_ext[1:] = rng.normal(0, 1, data.cfrc_ext[1:].shape)


@pytest.mark.parametrize("depth", [0, 1, 2])
@pytest.mark.parametrize(("robot", "split"), MAMUJOCO_SPLITS)
def test_observations_and_actions_of_the_installed_mamujoco(mamujoco, robot, split, depth):
    env = mamujoco(robot, split, depth)
    env.reset(seed=0)
    result = partition(robot, TREES[robot], LAYOUTS[robot], split, depth)
    assert result.agents == tuple(env.possible_agents)
    rng = np.random.default_rng(0)
    # Hopper clips velocities to [-10, 10] everywhere, walker2d only in the full observation: see below.
    for speed in (1, 9 if robot == "walker2d" else 20):
        put_in_random_state(env, rng, speed)
        full, local = env.state(), env._get_obs()
        assert full.shape == (LAYOUTS[robot].size,)
        for agent, indices in zip(result.agents, result.observations, strict=True):
            np.testing.assert_array_equal(full[list(indices)], local[agent])
    actions = {agent: rng.uniform(-1, 1, len(own)) for agent, own in zip(result.agents, result.actuators, strict=True)}
    control = np.full(sum(map(len, result.actuators)), np.nan)
    for agent, own in zip(result.agents, result.actuators, strict=True):
        control[list(own)] = actions[agent]
    np.testing.assert_array_equal(control, env.map_local_actions_to_global_action(actions))


def test_mamujoco_does_not_clip_walker2d_s_velocities_but_gymnasium_does(mamujoco):
    """The one difference that the docstring states."""
    env = mamujoco("walker2d", "2x3", 0)
    env.reset(seed=0)
    put_in_random_state(env, np.random.default_rng(0), 100)
    indices = partition("walker2d", TREES["walker2d"], LAYOUTS["walker2d"], "2x3", 0).observations[0]
    ours, theirs = env.state()[list(indices)], env._get_obs()["agent_0"]
    assert np.abs(theirs).max() > 10
    np.testing.assert_array_equal(ours, np.clip(theirs, -10, 10))


def test_no_depth_means_one_step_for_mamujoco_s_partitions():
    for robot, split in MAMUJOCO_SPLITS:
        given = (robot, TREES[robot], LAYOUTS[robot], split)
        assert partition(*given) == partition(*given, depth=1)
        assert partition(*given) != partition(*given, depth=0)


def test_own_partition_with_a_depth_is_seen_as_mamujoco_shows_it():
    legs = [LEGS[0] + LEGS[1], LEGS[2] + LEGS[3]]
    for depth in (0, 1, 2, 50):
        assert split_ant(legs, depth) == split_ant("2x4", depth) == split_ant("halves", depth)


@pytest.mark.parametrize("robot", GRAPHS)
def test_single_agent(robot):
    result = partition(robot, TREES[robot], LAYOUTS[robot], "single")
    num_controls = len(TREES[robot].joints)
    assert result.agents == ("agent_0",)
    assert result.actuators == (tuple(range(num_controls)),)
    assert result.observations == (tuple(range(LAYOUTS[robot].size)),)
    names = {joint.actuator: joint.name for joint in TREES[robot].joints}
    assert result.joints == (tuple(names[i] for i in range(num_controls)),)


@pytest.mark.parametrize("robot", GRAPHS)
def test_graphs_fit_the_models(robot):
    names = {joint.name for joint in TREES[robot].joints}
    graph = GRAPHS[robot]
    assert set().union(*graph.edges) == names
    for split in graph.splits.values():
        assert sorted(name for agent in split for name in agent) == sorted(names)
    for mapping in (graph.bodies, graph.root_velocity, graph.labels):
        assert set(mapping) <= names
    assert default_split(robot) == ("halves" if robot == "ant" else next(s for r, s in MAMUJOCO_SPLITS if r == robot))


def test_own_partition_of_the_humanoid():
    """Arms and the rest: joints in the order given, the others' positions in the model's."""
    arms = ["left_elbow", "left_shoulder1", "left_shoulder2", "right_elbow", "right_shoulder1", "right_shoulder2"]
    tree, layout = TREES["humanoid"], LAYOUTS["humanoid"]
    by_name = {joint.name: joint for joint in tree.joints}
    rest = [name for name in by_name if name not in arms]
    result = partition("humanoid", tree, layout, [arms, rest])
    assert result.joints == (tuple(arms), tuple(rest))
    assert result.bodies == (tuple(range(10, 14)), tuple(range(2, 10)))
    expected = [*range(5), *range(22, 28)]
    expected += [by_name[name].qpos - 2 for name in arms] + [by_name[name].qvel + 22 for name in arms]
    expected += range(45 + 9 * 10, 45 + 13 * 10)  # inertias of bodies 10 to 13
    expected += range(175 + 9 * 6, 175 + 13 * 6)
    expected += [253 + by_name[name].qvel - 6 for name in arms]
    expected += range(270 + 9 * 6, 270 + 13 * 6)
    expected += [by_name[name].qpos - 2 for name in rest]
    assert list(result.observations[0]) == expected


def test_a_body_held_by_joints_of_two_agents_is_both_s():
    """The humanoid's lower waist turns about two joints."""
    names = [joint.name for joint in TREES["humanoid"].joints]
    result = partition("humanoid", TREES["humanoid"], LAYOUTS["humanoid"], [["abdomen_z"], names[1:]])
    assert result.bodies == ((2,), tuple(range(2, 14)))


def test_what_is_not_observed_is_left_out():
    """brax's ant observes no forces: 27 entries."""
    layout = lay_out(15, 14, hidden=2)
    halves = split_ant("halves", layout=layout).observations
    assert list(halves[0]) == [i for i in PAPER["y-halves = MaMuJoCo 2x4: legs (1,2) y>0 | (3,4) y<0"][0] if i < 27]
    deep = split_ant("4x2", 2, ANT_V5).observations
    assert split_ant("4x2", 2, layout).observations == tuple(tuple(i for i in agent if i < 27) for agent in deep)


def test_partitions_are_hashable():
    assert len({split_ant("halves"), split_ant([LEGS[0] + LEGS[1], LEGS[2] + LEGS[3]]), split_ant("2x4")}) == 2


WALKER_LEG = ["thigh_joint", "leg_joint", "foot_joint"]


@pytest.mark.parametrize(
    ("robot", "split", "depth", "words"),
    [
        ("ant", "2x4x", None, ["split='2x4x'", "ant", "did you mean '2x4"]),
        ("ant", "2x3", None, ["split='2x3'", "did you mean '2x4"]),
        ("ant", "zzz", None, ["split='zzz'", "halves", "4x2", "single"]),
        ("walker2d", "halves", None, ["split='halves'", "walker2d", "2x3", "single"]),
        ("humanoid", "2x4", None, ["split='2x4'", "humanoid", "9|8"]),
        ("ant", [LEGS[0] + LEGS[1], LEGS[2] + ("hip_4", "ankel_4")], None, ["'ankel_4'", "'ankle_4'"]),
        ("ant", [LEGS[0], LEGS[1], LEGS[2]], None, ["'hip_4', 'ankle_4'", "no agent"]),
        ("ant", [*LEGS, ("hip_1",)], None, ["'hip_1'", "twice"]),
        ("ant", [LEGS[0] + LEGS[1] + LEGS[2] + LEGS[3], ()], None, ["agent 1", "no joints"]),
        ("ant", [], None, ["at least one agent"]),
        ("ant", ["hip_1", "hip_2"], None, ["split=['hip_1', 'hip_2']", "list of joint names"]),
        ("ant", None, None, ["split=None", "list of joint names"]),
        ("ant", 2, None, ["split=2", "list of joint names"]),
        ("walker2d", [WALKER_LEG, ["rootx"]], None, ["walker2d", "'rootx'"]),
        ("ant", "halves", -1, ["depth=-1", "at least 0"]),
        ("ant", "4x2", 1.0, ["depth=1.0", "integer"]),
        ("ant", "4x2", True, ["depth=True", "integer"]),
        ("ant", "4x2", "1", ["depth='1'", "integer"]),
        ("ant", "single", 1, ["depth=1", "single"]),
    ],
)
def test_refusals(robot, split, depth, words):
    with pytest.raises(OptionError) as error:
        partition(robot, TREES[robot], LAYOUTS[robot], split, depth)
    message = str(error.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_a_model_whose_joint_has_two_motors_is_refused():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='j' type='slide'/><geom size='1'/></body></worldbody>"
        "<actuator><motor joint='j'/><motor joint='j'/></actuator></mujoco>"
    )
    with pytest.raises(ValueError, match="two actuators"):
        describe(model)


def test_trees_are_values():
    assert TREES["ant"] == tree_of("ant") and hash(TREES["ant"]) == hash(tree_of("ant"))
    assert dataclasses.replace(TREES["ant"], root_qpos=()) != TREES["ant"]
