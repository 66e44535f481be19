"""Robots through MuJoCo's renderer: who has which color, what the camera follows, and what is said without OpenGL."""

import os
import subprocess
import sys
import types

import mujoco
import numpy as np
import pytest

from matd3_jax import config
from matd3_jax.envs import make
from matd3_jax.errors import UserError
from matd3_jax.figures.style import BLUE, VERMILION
from matd3_jax.video import frames, mujoco_renderer, opengl

XML = """
<mujoco>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0 0 1" rgb2="0 0 0" width="32" height="192"/>
    <texture name="checker" type="2d" builtin="checker" rgb1="0 0 0" rgb2=".8 .8 .8" width="100" height="100"/>
    <material name="floor" texture="checker" texrepeat="40 40" reflectance="0.5"/>
  </asset>
  <worldbody>
    <light directional="true" pos="0 0 3" dir="0 0 -1"/>
    <geom name="floor" type="plane" size="40 40 1" material="floor" rgba=".8 .9 .8 1"/>
    <body name="torso" pos="0 0 1">
      {root}
      <geom type="sphere" size="0.3" rgba="1 1 0 1"/>
      <body name="left"><joint axis="{axis}"/><geom type="capsule" fromto="0 0 0 -1 0 0" size="0.1"/></body>
      <body name="right"><joint axis="{axis}"/><geom type="capsule" fromto="0 0 0 1 0 0" size="0.1"/></body>
    </body>
  </worldbody>
</mujoco>
"""
FREE = {"root": "<freejoint/>", "axis": "0 1 0"}
SLIDES = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
PLANAR = {"root": SLIDES + '<joint axis="0 1 0"/>', "axis": "0 1 0"}


def robot(root: str, axis: str):
    """An environment as far as drawing needs it, whose states are its positions: two agents, an arm each."""
    model = mujoco.MjModel.from_xml_string(XML.format(root=root, axis=axis))
    return types.SimpleNamespace(
        mj_model=model, agent_bodies=((2,), (3,)), agents=("agent_0", "agent_1"), qpos=lambda state: state
    )


@pytest.fixture(scope="module")
def gl():
    try:
        return opengl.context_class()
    except UserError as error:
        pytest.skip(str(error))


def draw(env, qpos) -> list[np.ndarray]:
    """Pictures of 300 x 200 pixels."""
    drawing = mujoco_renderer.RobotDrawing(env)
    return [np.asarray(image, int) for image in drawing.images(np.asarray(qpos, np.float64), 300, 200)]


def hue(pixels, color):
    """Where pixels [..., 3] are a shade of a color, as lit surfaces are."""
    pixels = np.asarray(pixels, float)
    size = np.linalg.norm(pixels, axis=-1).clip(1)
    same = pixels @ (np.array(color) / np.linalg.norm(color)) / size > 0.985
    return same & (size > 60)


def test_each_agent_has_its_color_and_the_torso_none(gl):
    """Seen from the side, x to the right: the left arm blue, the right one vermilion, grey in between."""
    env = robot(**PLANAR)
    before = env.mj_model.geom_rgba.copy()
    (image,) = draw(env, [env.mj_model.qpos0])
    assert image.shape == (200, 300, 3)
    blue, vermilion = (np.argwhere(hue(image, color)) for color in (BLUE, VERMILION))
    assert len(blue) > 300 and len(vermilion) > 300
    assert blue[:, 1].max() < 150 < vermilion[:, 1].min()
    torso = image[int(blue[:, 0].mean()), 150]
    assert np.ptp(torso) < 12 and 40 < torso.mean() < 220
    np.testing.assert_array_equal(env.mj_model.geom_rgba, before)  # a copy was painted


def test_the_floor_is_a_quiet_checkerboard_under_a_white_sky(gl):
    (image,) = draw(robot(**PLANAR), [np.zeros(5)])
    assert image[2, 150].min() > 250
    dark, bright = mujoco_renderer.FLOOR
    for color in (dark, bright):
        assert np.sum(np.abs(image[120:] - color).max(axis=-1) < 20) > 1000


def test_the_camera_follows_and_the_floor_shows_it(gl):
    """20 m on, in steps: the robot is in the same place of the picture as at first, the floor is not."""
    env = robot(**FREE)
    path = np.tile(env.mj_model.qpos0, (60, 1))
    path[:, 0] = np.linspace(0, 20.3, 60)
    images = draw(env, path)
    centers = [np.argwhere(hue(image, BLUE) | hue(image, VERMILION)).mean(axis=0) for image in images[::15]]
    for center in centers:
        np.testing.assert_allclose(center, centers[0], atol=4)
    assert np.mean(np.abs(images[20] - images[21]).max(axis=-1) > 15) > 0.02


def test_a_robot_that_blew_up_stays_as_it_was(gl):
    env = robot(**FREE)
    path = np.tile(env.mj_model.qpos0, (3, 1))
    path[2] = np.nan
    images = draw(env, path)
    np.testing.assert_array_equal(images[1], images[2])
    assert hue(images[2], BLUE).sum() > 100


def test_pictures_come_with_caption_and_legend(gl):
    env = robot(**FREE)
    (frame,) = frames.frames(env, env.mj_model.qpos0[None], ["step 3   return 1.5"], size=320)
    pixels = np.asarray(frame, int)
    assert frame.size == (320, 240)
    assert (pixels[:18].max(axis=-1) < 60).sum() > 40
    for color in (BLUE, VERMILION):
        assert (np.abs(pixels[-18:] - color).max(axis=-1) < 3).sum() > 20


def test_drawing_works_whoever_imported_mujoco_first(gl):
    """MuJoCo chooses its OpenGL when it is imported, before anybody asked us."""
    program = (
        "import mujoco\nfrom matd3_jax.video import opengl\ncontext = opengl.context_class()(8, 8)\n"
        "context.make_current()\nmodel = mujoco.MjModel.from_xml_string('<mujoco/>')\n"
        "print(mujoco.MjrContext(model, 100).offWidth)\ncontext.free()"
    )
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and int(done.stdout) > 0, done.stderr


WITHOUT = """
import sys, types
from matd3_jax.cli import command
from matd3_jax.video import frames
env = types.SimpleNamespace(mj_model=None, agent_bodies=(), agents=(), qpos=None)
sys.argv = ["render"]
command.run(lambda argv: frames.drawing_of(env))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variables", "wanted"),
    [
        ({"MUJOCO_GL": "disabled"}, "MUJOCO_GL=disabled forbids"),
        ({"MUJOCO_GL": "vulkan"}, "apt install libegl1 libgl1-mesa-dri and MUJOCO_GL=egl, or apt install libosmesa6"),
        ({"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "none"}, "no OpenGL to draw robots with (tried MUJOCO_GL=egl)"),
    ],
)
def test_without_opengl_one_line_says_what_to_install(variables, wanted):
    environment = {**os.environ, **variables}
    done = subprocess.run([sys.executable, "-c", WITHOUT], env=environment, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1 and wanted in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize("name", ["ant", "swimmer", "brax_half_cheetah"])
def test_real_robots_show_every_agent(gl, name):
    env = make(name)
    (image,) = draw(env, [env.mj_model.qpos0])
    for agent in range(len(env.agents)):
        assert hue(image, mujoco_renderer.agent_color(agent)).sum() > 100, agent


@pytest.mark.slow
def test_an_opengl_that_mujoco_does_not_know_is_one_line_of_the_command(tmp_path):
    """Here MuJoCo cannot even be imported, hence the environment not be made."""
    config.write(config.load(["env=brax_hopper"]), tmp_path / "config.yaml")
    words = [sys.executable, "-m", "matd3_jax.render", f"run={tmp_path}"]
    done = subprocess.run(words, env={**os.environ, "MUJOCO_GL": "vulkan"}, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "vulkan" in done.stderr, done.stderr
    assert done.stderr.startswith("error: ") and [p.name for p in tmp_path.iterdir()] == ["config.yaml"]
