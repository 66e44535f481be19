"""Find an OpenGL that MuJoCo can draw with off screen."""

import functools
import importlib
import os
import platform
import subprocess
import sys
from typing import Any

from matd3_jax.errors import UserError

_TRY = """
import importlib, sys, mujoco
context = importlib.import_module(sys.argv[1]).GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
context.free()
print("drawn")
"""
_OFF = ("disable", "disabled", "off", "false", "0")
_ON = ("", "enable", "enabled", "on", "true", "1")
_NAMES = {"glx": "glfw", "wgl": "glfw"}
"""Values of MUJOCO_GL whose module in mujoco bears another name."""


@functools.cache
def context_class() -> Any:
    """MuJoCo's class of OpenGL contexts, `GLContext(width, height)`, that works here.

    The one that the environment variable MUJOCO_GL names, as MuJoCo reads it; where it is not set, the first that
    works of EGL, OSMesa and (with a display) GLFW on Linux, and the system's own elsewhere. Which is tried in a process
    of its own: one that fails may take the process along, or leave it unable to try the next.

    Raises UserError, with what to install, if none works.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in _OFF:
        raise UserError(f"MUJOCO_GL={wanted} forbids MuJoCo to draw: unset it, or set it to egl, osmesa or glfw")
    if wanted not in _ON:
        kinds = [_NAMES.get(wanted, wanted)]
    elif platform.system() == "Linux":
        kinds = ["egl", "osmesa"] + ["glfw"] * ("DISPLAY" in os.environ)
    else:
        kinds = ["cgl" if platform.system() == "Darwin" else "glfw"]
    for kind in kinds:
        if _works(kind):
            return importlib.import_module(f"mujoco.{kind}").GLContext
    tried = f"MUJOCO_GL={wanted}" if wanted not in _ON else ", ".join(kinds)
    raise UserError(
        f"MuJoCo finds no OpenGL to draw robots with (tried {tried}); on Debian or Ubuntu: "
        "apt install libegl1 libgl1-mesa-dri and MUJOCO_GL=egl, or apt install libosmesa6 and MUJOCO_GL=osmesa"
    )


def _works(kind: str) -> bool:
    # MuJoCo itself must not choose: it would fail before we can ask.
    environment = {**os.environ, "MUJOCO_GL": "disable"}
    try:
        done = subprocess.run(
            [sys.executable, "-c", _TRY, f"mujoco.{kind}"],
            env=environment,
            capture_output=True,
            timeout=60,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0 and b"drawn" in done.stdout
