"""Weights & Biases and MLflow: runs are sent to them by a process of its own, which cannot hold up the training."""
