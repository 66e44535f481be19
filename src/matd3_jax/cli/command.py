"""What the commands share: one clear line and exit code 2 for what a user can put right."""

import sys
from collections.abc import Callable, Sequence

from matd3_jax.errors import OptionError, UserError


def code(main: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """Run a command's `main`: its exit code, or 2 after an error line."""
    try:
        return main(argv)
    except (UserError, OptionError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run(main: Callable[[Sequence[str]], int]) -> None:
    """Run a command's `main` on the command line's arguments and leave with its exit code."""
    sys.exit(code(main, sys.argv[1:]))
