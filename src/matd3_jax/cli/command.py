"""What the commands share: help, one clear line and exit code 2 for what a user can put right, lines to copy."""

import functools
import importlib
import shlex
import sys
from collections.abc import Callable, Sequence

from matd3_jax.cli import arguments, options
from matd3_jax.cli.options import Command
from matd3_jax.errors import OptionError, UserError

DIVERGED = 3
"""Exit code where all seeds diverged, or one did that ended the run (docs/running.md)."""


def start(name: str, argv: Sequence[str]) -> int:
    """Run one of our commands by its name: its exit code. Help needs none of what the command itself imports."""
    if options.asks_for_help(argv):
        print(arguments.COMMANDS[name].help())
        return 0
    return importlib.import_module(f"matd3_jax.cli.{name}").main(argv)


def code(main: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """Run a command's `main`: its exit code, or 2 after an error line."""
    try:
        return main(argv)
    except (UserError, OptionError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run(main: Callable[[Sequence[str]], int], command: Command | None = None) -> None:
    """Run a command's `main` on the command line's arguments and leave with its exit code.

    command: whose help `--help` prints, where `main` does not.
    """
    if command is not None and options.asks_for_help(sys.argv[1:]):
        print(command.help())
        sys.exit(0)
    sys.exit(code(main, sys.argv[1:]))


def run_named(name: str) -> None:
    """`run` for one of our commands."""
    run(functools.partial(start, name))


def line(module: str, *arguments: str, **values: object) -> str:
    """A command line to copy into a shell: `python -m MODULE`, the arguments and `key=value`, quoted where needed."""
    given = [*arguments, *(f"{key}={value}" for key, value in values.items())]
    return shlex.join(["python", "-m", module, *given])
