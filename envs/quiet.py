"""Silence for libraries that speak up where there is nothing the user could do about it."""

import contextlib
import io
import warnings
from collections.abc import Iterator


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """No Python warnings and nothing on standard output within; exceptions pass.

    MJX prints which optional packages it lacks, brax warns that it is not developed further, both use what other
    packages call deprecated.
    """
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def quiet_compiler() -> Iterator[None]:
    """No warnings from MuJoCo's model compiler, which prints them and logs them in the working directory."""
    import mujoco

    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)
