"""Episodes of trained policies: trajectories and cross-play."""
