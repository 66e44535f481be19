"""Robots whose joints are shared out among agents."""

import os


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
            import mujoco  # noqa: F401
        finally:
            os.environ["MUJOCO_GL"] = wanted


_import_mujoco()
