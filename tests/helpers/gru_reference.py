"""Gated recurrent units in NumPy of float64, written by themselves."""

import numpy as np


def one_step(p, h, z):
    """A gated recurrent unit in NumPy: its equations once more."""
    kernel, own = (np.split(p[name], 3, axis=-1) for name in ("kernel", "recurrent_kernel"))
    bias = np.split(p["bias"], 3, axis=-1)
    update, reset = (1 / (1 + np.exp(-(z @ kernel[k] + bias[k] + h @ own[k]))) for k in range(2))
    candidate = np.tanh(z @ kernel[2] + bias[2] + reset * (h @ own[2] + p["candidate_bias"]))
    return (1 - update) * candidate + update * h
