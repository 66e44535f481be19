"""Pictures of robots with MuJoCo's renderer: each agent's parts in a color of its own."""

import copy
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from PIL import Image

from matd3_jax.figures.style import AGENT, Color
from matd3_jax.video import opengl
from matd3_jax.video.scene2d import Drawing

TRUNK: Color = (190, 190, 190)
"""Bodies that are nobody's own."""
FLOOR: tuple[Color, Color] = ((196, 202, 210), (226, 230, 235))
"""The two colors of a checkered floor; close to each other, so that the robot stands out."""
DISTANCE = 3.0
"""Of the camera, in half lengths of the robot."""
SMOOTHING = 4
"""The camera follows the mean position of the torso over this many frames before and after."""


class RobotDrawing(Drawing):
    """Draws an environment that has `mj_model`, `agent_bodies` and `qpos(state)`.

    mj_model: the robot, a `mujoco.MjModel`. agent_bodies: for each agent the bodies that are its own. qpos: the
    generalized positions [nq] in a state.

    Raises UserError where there is no OpenGL.
    """

    aspect = 4 / 3
    fps = 20

    def __init__(self, env: Any):
        self.env, self.new_context = env, opengl.context_class()
        self.legend = tuple((agent, agent_color(i)) for i, agent in enumerate(env.agents))

    def select(self, state: Any) -> Any:
        return self.env.qpos(state)

    def images(self, selected: Any, width: int, height: int) -> Iterator[Image.Image]:
        """One picture for each of qpos [frames, nq]."""
        import mujoco

        model = painted(self.env.mj_model, self.env.agent_bodies)
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        data = mujoco.MjData(model)
        qpos = _finite(np.asarray(selected, np.float64))
        camera, path = _camera(model, data, qpos), _smooth(_torso_path(model, data, qpos))
        # Not `mujoco.Renderer`: it draws with the OpenGL that MuJoCo chose when it was imported, GLFW on Linux unless
        # MUJOCO_GL says otherwise, and closing one while another is current spoils the other's pictures (3.17.0).
        scene, option, perturb = mujoco.MjvScene(model, 10_000), mujoco.MjvOption(), mujoco.MjvPerturb()
        rect = mujoco.MjrRect(0, 0, width, height)
        context = self.new_context(width, height)
        context.make_current()
        renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        try:
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, renderer)
            for position, center in zip(qpos, path, strict=True):
                data.qpos[:] = position
                mujoco.mj_forward(model, data)
                camera.lookat[:2] = center
                mujoco.mjv_updateScene(model, data, option, perturb, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
                context.make_current()  # whoever takes the pictures may draw something else in between
                mujoco.mjr_render(rect, scene, renderer)
                pixels = np.empty((height, width, 3), np.uint8)
                mujoco.mjr_readPixels(pixels, None, rect, renderer)
                yield Image.fromarray(pixels[::-1])
        finally:
            context.make_current()
            renderer.free()
            context.free()


def agent_color(agent: int) -> Color:
    """The color of an agent's parts."""
    return AGENT[agent % len(AGENT)]


def painted(mj_model: Any, agent_bodies: Sequence[Sequence[int]]) -> Any:
    """A copy of a `mujoco.MjModel` with agents in their colors, the rest of the robot grey, floor and sky light."""
    import mujoco

    model = copy.deepcopy(mj_model)
    color = {body: agent_color(i) for i, bodies in enumerate(agent_bodies) for body in bodies}
    for geom, body in enumerate(model.geom_bodyid):
        if body:
            model.geom_matid[geom] = -1
            model.geom_rgba[geom, :3] = np.array(color.get(int(body), TRUNK)) / 255
        elif (material := model.geom_matid[geom]) >= 0:
            model.geom_rgba[geom] = 1
            model.mat_rgba[material] = 1
            model.mat_texrepeat[material] *= 0.5  # larger squares: calmer, and a smaller GIF
            model.mat_reflectance[material] = model.mat_specular[material] = 0
            if (texture := model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]) >= 0:
                pixels = _pixels(model, texture)
                bright = pixels.mean(axis=1) > pixels.mean()
                pixels[:] = np.where(bright[:, None], *reversed(FLOOR))
    for texture in range(model.ntex):
        if model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_SKYBOX:
            _pixels(model, texture)[:] = 255
    model.vis.quality.shadowsize = 1024  # a quarter of the default: enough for small pictures, and much faster
    # Light from everywhere, and from afar so that the floor has the same colors all over: a small GIF.
    model.vis.headlight.ambient[:], model.vis.headlight.specular[:] = 0.7, 0
    model.vis.headlight.diffuse[:] = 0 if model.nlight else 0.35
    model.light_type[:] = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    model.light_ambient[:], model.light_specular[:], model.light_diffuse[:] = 0, 0, 0.35 / max(1, model.nlight)
    return model


def _pixels(model: Any, texture: int) -> np.ndarray:
    """View of a texture's pixels, [number, 3]."""
    channels = int(model.tex_nchannel[texture])
    start, count = model.tex_adr[texture], model.tex_width[texture] * model.tex_height[texture]
    return model.tex_data[start : start + channels * count].reshape(-1, channels)[:, :3]


def _finite(qpos: np.ndarray) -> np.ndarray:
    """[frames, nq] where a frame that is not finite (physics that blew up) repeats the one before it."""
    sound = np.isfinite(qpos).all(axis=1)
    return qpos[np.maximum.accumulate(np.where(sound, np.arange(len(qpos)), 0))]


def _torso_path(model: Any, data: Any, qpos: np.ndarray) -> np.ndarray:
    """Where the torso (the first body) is above the floor: [frames, 2]."""
    import mujoco

    path = []
    for position in qpos:
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        path.append(data.xpos[1, :2].copy())
    return np.array(path)


def _smooth(path: np.ndarray) -> np.ndarray:
    """Means over `SMOOTHING` frames before and after, fewer at the ends, of [frames, 2]."""
    frames = np.arange(len(path))
    reach = np.minimum(SMOOTHING, np.minimum(frames, frames[::-1]))
    return np.array([path[t - r : t + r + 1].mean(axis=0) for t, r in zip(frames, reach, strict=True)])


def _camera(model: Any, data: Any, qpos: np.ndarray) -> Any:
    """A camera at a distance that suits the robot, on the side from which one sees its joints move."""
    import mujoco

    data.qpos[:] = qpos[0]
    mujoco.mj_kinematics(model, data)
    own = model.geom_bodyid > 0
    position, around = data.geom_xpos[own], model.geom_rbound[own]
    low, high = (position - around[:, None]).min(axis=0), (position + around[:, None]).max(axis=0)
    camera = mujoco.MjvCamera()
    camera.distance = DISTANCE * float((high - low).max()) / 2
    camera.lookat[2] = (max(low[2], 0) + high[2]) / 2
    hinges = np.abs(model.jnt_axis[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE])
    free = np.any(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    if not free and np.all(hinges[:, 1] > 0.99):  # it moves in the plane of x and z
        camera.azimuth, camera.elevation = 90, -12
    elif not free and np.all(hinges[:, 2] > 0.99):  # of x and y
        camera.azimuth, camera.elevation = 90, -60
    else:
        camera.azimuth, camera.elevation = 110, -35
    return camera
