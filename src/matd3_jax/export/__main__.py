"""`python -m matd3_jax.export`: write a run's policies for other programs."""

from matd3_jax.cli import command

if __name__ == "__main__":
    command.run_named("export")
