"""States and actions of particle tasks to step from, for the tests that compare single steps."""

import numpy as np

from matd3_jax.envs.particle.world import State

NUM_STATES = 250  # as many as a recording has, so that both share a compiled program


def random_states(env, rng):
    """Spread over the plane (reaching beyond the unit square), crowded, and piled up; some faster than any limit."""
    n, num_landmarks = len(env.agents), len(env.world.landmark_radius)
    scale = rng.choice([1.5, 0.4, 0.1], (NUM_STATES, 1, 1))
    center = rng.uniform(-1, 1, (NUM_STATES, 1, 2))
    place = center + scale * rng.uniform(-1, 1, (NUM_STATES, n + num_landmarks, 2))
    movable = np.array(env.world.movable)
    comm = None
    if env.dim_c:
        comm = rng.uniform(0, 1, (NUM_STATES, n, env.dim_c)) * np.array(env.speaks)[:, None]
        comm *= rng.uniform(size=(NUM_STATES, n, 1)) > 0.2
    return State(
        pos=place[:, :n],
        vel=rng.normal(0, 0.7, (NUM_STATES, n, 2)) * movable[:, None],
        comm=comm,
        landmark=place[:, n:],
        goal=rng.integers(env.num_goals, size=(NUM_STATES, *env.goal_shape), dtype=np.int32) if env.num_goals else None,
        key=rng.integers(env.num_keys, size=NUM_STATES, dtype=np.int32) if env.num_keys else None,
        step=rng.integers(25, size=NUM_STATES, dtype=np.int32),
    )


def random_actions(env, rng):
    if env.actions == "discrete":
        return tuple(
            rng.integers(space.sizes, size=(NUM_STATES, len(space.sizes)), dtype=np.int32).reshape(-1, *space.shape)
            for space in env.action_spaces
        )
    # Partly outside [0, 1], where mpe2's wrapper clips; partly zero, for silence in simple_crypto.
    shapes = [(NUM_STATES, space.size) for space in env.action_spaces]
    return tuple(rng.uniform(-0.3, 1.3, shape) * (rng.uniform(size=(NUM_STATES, 1)) > 0.1) for shape in shapes)
