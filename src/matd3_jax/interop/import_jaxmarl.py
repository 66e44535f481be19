"""Importing JaxMARL, which is an optional package and not quiet."""

import contextlib
import io
import sys
from typing import Any
from unittest import mock

from matd3_jax.envs.robots.quiet import quiet
from matd3_jax.errors import OptionError


def import_jaxmarl(what: str) -> Any:
    """The module jaxmarl. Raises OptionError, which says that `what` needs it, where it is missing."""
    try:
        # JaxMARL's import prints, and leaves sys.stdout and sys.stderr as sys.__stdout__ and sys.__stderr__.
        with quiet(), mock.patch.object(sys, "__stdout__", io.StringIO()), contextlib.redirect_stderr(sys.stderr):
            import jaxmarl
    except ImportError as error:
        raise OptionError(f"{what} needs the extra 'jaxmarl': pip install 'matd3_jax[jaxmarl]' ({error})") from error
    return jaxmarl
