"""Shared by the tests that compare single steps."""

import functools

import jax
import pytest


@pytest.fixture(scope="session")
def observe_and_step(fully_optimized):
    """env -> compiled (states, actions) -> (observations in the states, steps from them), over a leading axis.

    Kept for the session: compiling is what takes the time here, and files compare the same environments.
    """

    @functools.cache
    def program(env):
        return fully_optimized(jax.vmap(lambda state, action: (env.observe(state), env.step(None, state, action))))

    return program
