"""`python -m matd3_jax.evaluate`: play episodes with trained policies."""

from matd3_jax.cli import command

if __name__ == "__main__":
    command.run_named("evaluate")
