"""Errors from outside are reported in one line; faults of the program are not taken for them."""

import errno
import os
import subprocess
import sys

import numpy as np
import pytest

from matd3_jax.cli import command
from matd3_jax.errors import UserError
from matd3_jax.runtime import outside


def raised(act) -> BaseException:
    """The error that `act` ends with."""
    try:
        act()
    except BaseException as error:
        return error
    raise AssertionError("nothing was raised")


def test_errors_of_the_system_name_the_file(tmp_path):
    assert outside.describe(raised((tmp_path / "none").read_text)) == f"{tmp_path / 'none'}: No such file or directory"
    assert outside.describe(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))) == "No space left on device"
    assert outside.describe(OSError("Cannot call rmtree on a symbolic link")) == "Cannot call rmtree on a symbolic link"
    said = outside.describe(raised(lambda: os.rename(tmp_path / "a", tmp_path / "b")))
    assert said == f"{tmp_path / 'a'} -> {tmp_path / 'b'}: No such file or directory"
    written = ValueError("INTERNAL: Failed writing: \"/x/d\": Failed to write: ... [os_error_code='28']")
    assert outside.describe(written) == "/x/d: No space left on device"


def test_memory(tmp_path):
    said = outside.describe(raised(lambda: np.zeros((10**7, 10**7))))
    assert said.startswith("out of memory (Unable to allocate") and "take fewer seeds" in said
    assert outside.describe(MemoryError()).startswith("out of memory: take fewer")
    assert outside.describe(RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8 bytes")).startswith("out of")


def test_packages():
    def missing():
        import no_such_package_at_all  # noqa: F401

    def other():
        from json import no_such_name  # noqa: F401

    assert outside.describe(raised(missing)).startswith("the package no_such_package_at_all is missing: ")
    assert "cannot import name 'no_such_name' from 'json'" in outside.describe(raised(other))

    def ours():
        import matd3_jax.no_such_module  # noqa: F401

    assert outside.describe(raised(ours)) is None


@pytest.mark.parametrize("fault", [KeyError("env"), AssertionError(), TypeError("x"), ValueError("x"), IndexError(3)])
def test_faults_of_the_program_pass(fault):
    def main(argv):
        raise fault

    assert outside.describe(fault) is None
    with pytest.raises(type(fault)):
        command.code(main, [])


def test_exit_codes_and_lines(capfd, tmp_path):
    def ending_with(error):
        def main(argv):
            raise error

        return main

    assert command.code(ending_with(KeyboardInterrupt()), []) == 130
    assert capfd.readouterr().err == "interrupted\n"
    assert command.code(ending_with(UserError("two\nlines \x1b[31m and \udcff")), []) == 2
    assert capfd.readouterr().err == "error: two\\nlines \\x1b[31m and \\udcff\n"
    assert command.code(ending_with(UserError("x" * 10**6)), []) == 2
    assert 1000 < len(capfd.readouterr().err) < 3000


def test_what_can_be_resumed_is_said(tmp_path):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "state")
    with pytest.raises(OSError), command.resumable("matd3_jax.train", lambda: tmp_path):
        raise full  # no run there yet
    (tmp_path / "config.yaml").touch()
    with pytest.raises(UserError) as found, command.resumable("matd3_jax.train", lambda: tmp_path):
        raise full
    line = f"python -m matd3_jax.train resume={tmp_path}"
    assert str(found.value) == f"state: No space left on device; resume with: {line}"
    with pytest.raises(ZeroDivisionError), command.resumable("matd3_jax.train", lambda: tmp_path):
        raise ZeroDivisionError


def test_a_platform_that_is_not_there():
    environment = {**os.environ, "JAX_PLATFORMS": "cuda"}
    words = [sys.executable, "-m", "matd3_jax.train", "env=point_reach"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    if "CudaDevice" in done.stdout:
        pytest.skip("there is a GPU")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: JAX cannot start JAX_PLATFORMS=cuda")
