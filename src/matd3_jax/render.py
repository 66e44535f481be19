"""`python -m matd3_jax.render`: make a film of an episode."""

from matd3_jax.cli import command

if __name__ == "__main__":
    command.run_named("render")
