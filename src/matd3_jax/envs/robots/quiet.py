"""Silence for libraries that speak up where there is nothing the user could do about it."""

import contextlib
import io
import threading
import warnings
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """No Python warnings and nothing on standard output within; exceptions pass.

    MJX prints which optional packages it lacks, brax warns that it is not developed further, both use what other
    packages call deprecated.
    """
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


_lock = threading.Lock()
_inside = 0
_listener: Callable | None = None


@contextlib.contextmanager
def quiet_mujoco() -> Iterator[None]:
    """No warnings from MuJoCo, its model compiler included, which prints them and logs them in the working directory.

    MuJoCo has one listener for the whole process: the first thread that comes in takes it away, and the last that goes
    out puts it back.
    """
    global _inside, _listener
    import mujoco

    with _lock:
        if _inside == 0:
            _listener = mujoco.get_mju_user_warning()
            mujoco.set_mju_user_warning(lambda message: None)
        _inside += 1
    try:
        yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                mujoco.set_mju_user_warning(_listener)
