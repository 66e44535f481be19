"""Robots whose joints are shared out among agents."""
