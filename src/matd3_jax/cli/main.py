"""`matd3 COMMAND ...`: every command under one name."""

from collections.abc import Sequence

from matd3_jax.cli import command
from matd3_jax.errors import UserError, nearest
from matd3_jax.runtime.terminal import say

COMMANDS = {
    "train": "train, and leave a run directory",
    "sweep": "train many settings, and rank them",
    "evaluate": "play episodes with trained policies",
    "crossplay": "play every run's agents against every run's adversaries",
    "plot": "draw learning curves of runs",
    "render": "make a film of an episode",
    "export": "write policies for other programs: ONNX, NumPy, JAX",
    "report": "write a page about runs",
    "check": "say what a run directory holds and what is damaged",
}

HELP = "usage: matd3 COMMAND [key=value ...]\n\ncommands (matd3 COMMAND --help says more):\n" + "\n".join(
    f"  {name:<10} {what}" for name, what in COMMANDS.items()
)


def main(argv: Sequence[str]) -> int:
    """Run a command by its name; the exit code. Raises UserError for a name that is none."""
    if not argv or argv[0] in ("-h", "--help"):
        say(HELP)
        return 0 if argv else 2
    name, *rest = argv
    if name not in COMMANDS:
        raise UserError(f"there is no command {name!r}; {nearest(name, COMMANDS)}")
    return command.start(name, rest)


def script() -> None:
    """What the console script `matd3` calls."""
    command.run(main)
