"""`python -m matd3_jax.sweep`: train many settings, and rank them."""

from matd3_jax.cli import command

if __name__ == "__main__":
    command.run_named("sweep")
