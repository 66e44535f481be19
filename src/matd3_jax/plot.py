"""`python -m matd3_jax.plot`: draw learning curves of runs."""

from matd3_jax.cli import command

if __name__ == "__main__":
    command.run_named("plot")
