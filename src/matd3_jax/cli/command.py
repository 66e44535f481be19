"""What the commands share: help, one clear line and exit code 2 for what a user can put right, lines to copy."""

import contextlib
import functools
import importlib
import io
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from matd3_jax.cli import catalog, options
from matd3_jax.cli.options import Command
from matd3_jax.errors import OptionError, UserError
from matd3_jax.runtime import callbacks, interrupt, outside
from matd3_jax.runtime.terminal import complain, leave, say

DIVERGED = 3
"""Exit code where all seeds diverged, or one did that ended the run (docs/running.md)."""


def start(name: str, argv: Sequence[str]) -> int:
    """Run one of our commands by its name: its exit code. Help needs none of what the command itself imports."""
    if options.asks_for_help(argv):
        say(catalog.COMMANDS[name].help())
        return 0
    with interrupt.ends_at_once():
        module = importlib.import_module(f"matd3_jax.cli.{name}")
        from matd3_jax.runtime import devices  # imports JAX, which help does without

    with devices.standard_numerics():
        return module.main(argv)


def code(main: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """Run a command's `main`: its exit code, or 2 after an error line; a fault of our own passes."""
    callbacks.handle_errors()
    try:
        return main(argv)
    except (UserError, OptionError) as error:
        complain(f"error: {error}")
        return 2
    except KeyboardInterrupt:
        complain("interrupted")
        return interrupt.EXIT_CODE
    except Exception as error:
        line = outside.describe(error)
        if line is None:
            raise
        complain(f"error: {line}")
        return 2


@contextlib.contextmanager
def resumable(module: str, where: Callable[[], Path | None]) -> Iterator[None]:
    """Where an error from outside ends the block, say how to resume what is in the directory that `where` gives."""
    try:
        yield
    except (UserError, OptionError):
        raise
    except Exception as error:
        text, path = outside.describe(error), where()
        if text is None or path is None or not (path / "config.yaml").is_file():
            raise
        raise UserError(f"{text}; resume with: {line(module, resume=path)}") from error


def run(main: Callable[[Sequence[str]], int], command: Command | None = None) -> None:
    """Run a command's `main` on the command line's arguments and leave with its exit code.

    command: whose help `--help` prints, where `main` does not.
    """
    prepare_output()
    if command is not None and options.asks_for_help(sys.argv[1:]):
        say(command.help())
        sys.exit(0)
    try:
        exit_code = code(main, sys.argv[1:])
    except SystemExit:  # after a second signal
        leave(at_once=True)
        raise
    leave()
    sys.exit(exit_code)


def prepare_output() -> None:
    """Let what a terminal lacks the letters for be printed as escapes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def run_named(name: str) -> None:
    """`run` for one of our commands."""
    run(functools.partial(start, name))


def line(module: str, *arguments: str, **values: object) -> str:
    """A command line to copy into a shell: `python -m MODULE`, the arguments and `key=value`, quoted where needed."""
    given = [*arguments, *(f"{key}={value}" for key, value in values.items())]
    return shlex.join(["python", "-m", module, *given])
