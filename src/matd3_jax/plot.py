"""`python -m matd3_jax.plot`: draw learning curves of runs."""

from matd3_jax.cli import command, plot

if __name__ == "__main__":
    command.run(plot.main)
