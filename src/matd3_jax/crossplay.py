"""`python -m matd3_jax.crossplay`: play every run's agents against every run's adversaries."""

from matd3_jax.cli import command

if __name__ == "__main__":
    command.run_named("crossplay")
