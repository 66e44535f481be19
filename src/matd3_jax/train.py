"""`python -m matd3_jax.train`: train, and leave a run directory."""

from matd3_jax.cli import command

if __name__ == "__main__":
    command.run_named("train")
