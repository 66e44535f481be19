"""Learning itself: algorithms, networks, losses, updates, replay and rollouts, in pure JAX."""
