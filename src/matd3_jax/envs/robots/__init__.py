"""Robots whose joints are shared out among agents."""

import os
import sys


def _import_mujoco() -> None:
    """Import MuJoCo also where the OpenGL that MUJOCO_GL names is not there: only drawing needs one."""
    try:
        import mujoco  # noqa: F401
    except (AttributeError, ImportError, OSError, RuntimeError):
        wanted = os.environ.get("MUJOCO_GL")
        if wanted is None:
            raise
        os.environ["MUJOCO_GL"] = "disable"
        try:
            import mujoco
        finally:
            os.environ["MUJOCO_GL"] = wanted
        # What the first attempt had imported already is not imported, and hence not made an attribute, again.
        for name, module in list(sys.modules.items()):
            package, _, own = name.partition(".")
            if package == "mujoco" and own and "." not in own and not hasattr(mujoco, own):
                setattr(mujoco, own, module)


_import_mujoco()
