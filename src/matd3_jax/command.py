"""What the commands share: one clear line and exit code 2 for what a user can put right."""

import sys
from collections.abc import Callable, Sequence

from matd3_jax.envs.base import OptionError
from matd3_jax.errors import UserError


def run(main: Callable[[Sequence[str]], int]) -> None:
    """Run a command's `main` on the command line's arguments and leave with its exit code."""
    try:
        code = main(sys.argv[1:])
    except (UserError, OptionError) as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    sys.exit(code)
