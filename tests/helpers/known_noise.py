"""Noise that a test knows, in place of every draw of an update."""

import contextlib

import numpy as np
import pytest

from matd3_jax.core.policies import CategoricalPolicy, DeterministicPolicy


def table(kind, size, batch):
    """The noise [batch, size] that stands in for every draw of that kind and size: the same for all agents, so that
    keys and the order of draws do not matter."""
    rng = np.random.default_rng([size, kind == "normal"])
    return rng.gumbel(size=(batch, size)) if kind == "gumbel" else rng.normal(size=(batch, size))


@contextlib.contextmanager
def known(batch):
    """Who samples or smooths gets the table's noise; whether there is noise at all stays the learner's choice."""
    with pytest.MonkeyPatch.context() as patch:
        for kind in (DeterministicPolicy, CategoricalPolicy):

            def sample(policy, output, draw, *scale, real=kind.sample):
                draw = None if draw is None else table("gumbel", policy.size, batch)
                return real(policy, output, draw, *scale)

            def smooth(policy, action, draw, *options, real=kind.smooth):
                return real(policy, action, table("normal", policy.size, batch), *options)

            patch.setattr(kind, "sample", sample)
            patch.setattr(kind, "smooth", smooth)
        yield
