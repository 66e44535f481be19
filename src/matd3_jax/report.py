"""`python -m matd3_jax.report`: write a report of runs as one HTML page."""

from matd3_jax.cli import command

if __name__ == "__main__":
    command.run_named("report")
