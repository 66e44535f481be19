"""`python -m matd3_jax.check`: say what a run directory holds, what is damaged, and how to resume it."""

from matd3_jax.cli import command

if __name__ == "__main__":
    command.run_named("check")
