"""Episodes that end are followed by the same ones whether resets are made beforehand or where they are needed."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from ledger import HYPER

from matd3_jax import envs
from matd3_jax.core import rollout, update
from matd3_jax.core.acting import PolicyParams
from matd3_jax.core.agents import JointLayout
from matd3_jax.core.algorithm import Algorithm
from matd3_jax.envs.wrappers.joint_team import JointTeam

SEEDS, ENVS, LENGTH = 2, 3, 40
resets = []


@dataclasses.dataclass(frozen=True, kw_only=True)
class Falling(type(envs.make("point_reach"))):
    """Terminates at random, in about one of twenty steps."""

    costly_reset: bool = False

    def reset(self, key):
        def count(data):
            resets.append(data.shape[:-1])
            return data

        # Pure, so that the compiler may move it as it would a simulation.
        data = jax.random.key_data(key)
        counted = jax.pure_callback(count, data, data, vmap_method="broadcast_all")
        return super().reset(jax.random.wrap_key_data(counted))

    def step(self, key, state, action):
        return super().step(key, state, action)._replace(terminated=jax.random.uniform(key) < 0.05)


def played(env):
    """(environments at the end, rows [seeds, steps * envs, row], leading axes of the resets) of random play."""
    layout = JointLayout.of(env, {"agents": Algorithm(hidden=(4,))})
    actors = tuple(group.actor for group in update.init(layout, jax.random.key(0)))
    policy = PolicyParams(actors, (HYPER,) * len(layout.groups), None)
    keys = jax.random.split(jax.random.key(1), SEEDS)
    start = jax.vmap(lambda key: rollout.start(env, key, ENVS))(keys)
    jax.block_until_ready(start)
    resets.clear()
    collect = functools.partial(rollout.collect, env, layout, policy, length=LENGTH, random=True)
    end, rows, _, _ = jax.jit(jax.vmap(lambda state, key: collect(env_state=state, key=key)))(start, keys)
    return end, np.asarray(rows), list(resets)


@pytest.mark.slow
@pytest.mark.parametrize("joint", [False, True])
def test_resets_are_made_where_they_are_needed(joint):
    made = []
    for costly in (False, True):
        env = Falling(num_agents=2, episode_length=15, costly_reset=costly)
        made.append(played(JointTeam(env, ("agents",)) if joint else env))
    (end, rows, beforehand), (same_end, same_rows, needed) = made
    # The same starts and the same steps, compiled in another order of operations.
    np.testing.assert_allclose(rows, same_rows, rtol=1e-5, atol=1e-6)
    for one, other in zip(jax.tree.leaves(end), jax.tree.leaves(same_end), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
    assert beforehand == [(SEEDS, LENGTH, ENVS)]
    # The discount is 0 where an episode terminated; the others of an environment's episodes have 15 steps.
    discount = rows[..., -1].reshape(SEEDS, LENGTH, ENVS)
    ended, since = np.zeros((SEEDS, LENGTH, ENVS), bool), np.zeros((SEEDS, ENVS), int)
    for t in range(LENGTH):
        since += 1
        ended[:, t] = (discount[:, t] == 0) | (since == 15)
        since[ended[:, t]] = 0
    times = ended.any(axis=(0, 2)).sum()
    assert needed == [(SEEDS, ENVS)] * times and 2 < times < LENGTH / 2
