"""Robots simulated with MuJoCo MJX, and how their joints are shared out among agents."""
