"""Whether what was written gives what JAX gives: on observations from played episodes, and on random ones."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from matd3_jax.core import acting, rollout
from matd3_jax.core.acting import PolicyParams
from matd3_jax.envs.spaces import ActionSpace, Box, Discrete, Simplex
from matd3_jax.errors import UserError
from matd3_jax.training.session import TrainingSession

OBSERVATIONS = 1000
"""On which an exported policy is compared: half of them played, half random."""
TOLERANCE = 1e-5
"""Of probabilities, and of real numbers in half ranges."""
ENVIRONMENTS, WIDTH = 2, 3.0
"""Played side by side; standard deviations of the random ones, in those of the played."""


def observations(training: TrainingSession, policy: PolicyParams) -> np.ndarray:
    """Joint observations [OBSERVATIONS, observation_size]: of episodes under exploration noise, then as many normal
    ones, `WIDTH` times as far from their mean.

    Args:
        policy: of one seed.
    """
    env, layout, played = training.env, training.layout, OBSERVATIONS // 2

    def play(policy: PolicyParams, key: Any) -> Any:
        start_key, key = jax.random.split(key)
        start = rollout.start(env, start_key, ENVIRONMENTS, acting.ranged(layout))
        return layout.row_parts(rollout.collect(env, layout, policy, start, key, played // ENVIRONMENTS)[1]).x

    seen = np.asarray(jax.jit(play)(jax.tree.map(jnp.asarray, policy), jax.random.key(0)), np.float32)
    mean, deviation = seen.mean(axis=0), seen.std(axis=0)
    noise = np.random.default_rng(0).normal(size=(OBSERVATIONS - played, seen.shape[1]))
    drawn = mean + WIDTH * np.maximum(deviation, 1e-3) * noise
    return np.concatenate([seen, drawn]).astype(np.float32)


def wanted(training: TrainingSession, policy: PolicyParams, seen: np.ndarray) -> list[np.ndarray]:
    """What each agent does with observations, by the code that evaluations play with."""
    layout = training.layout
    parts = [layout.observation_part(jnp.asarray(seen), i) for i in range(layout.num_agents)]
    with jax.default_matmul_precision("highest"):
        found, _ = jax.jit(lambda policy: acting.decide(layout, policy, parts, None))(jax.tree.map(jnp.asarray, policy))
    return [np.asarray(action) for action in found]


def difference(
    space: ActionSpace, action: np.ndarray, expected: np.ndarray, probabilities: np.ndarray | None, soft: Any
) -> float:
    """The largest difference between an exported policy's actions and JAX's, in half ranges or as probabilities.

    Choices have to be the same, but where the two likeliest options of JAX's are within `TOLERANCE`: infinite
    otherwise.

    Args:
        action, expected: of both, leading axis [observations].
        probabilities, soft: of all options; None for real numbers.
    """
    if action.shape != expected.shape or action.dtype != expected.dtype:
        return np.inf
    if isinstance(space, Box):
        return _largest((action - expected) / ((space.high - space.low) / 2))
    assert probabilities is not None
    if isinstance(space, Simplex):
        return max(_largest(action - expected), _largest(probabilities - soft))
    columns = (action[:, None], expected[:, None]) if isinstance(space, Discrete) else (action, expected)
    for k, part in enumerate(np.split(np.asarray(soft), np.cumsum(space.sizes)[:-1], axis=1)):
        first, second = np.sort(part, axis=1)[:, :-3:-1].T
        if ((columns[0][:, k] != columns[1][:, k]) & (first - second > TOLERANCE)).any():
            return np.inf
    return _largest(probabilities - soft)


def check(
    name: str, by: str, space: ActionSpace, found: Mapping[str, Any], expected: np.ndarray, function: Callable,
    seen: np.ndarray,
) -> float:  # fmt: skip
    """The largest difference. Raises UserError where it is more than `TOLERANCE`.

    Args:
        found: "action", and of choices "probabilities".
        function: the policy in JAX (`policy.function`).
        seen: the agent's observations.
    """
    soft = None if isinstance(space, Box) else np.asarray(function(seen)["probabilities"])
    probabilities = None if isinstance(space, Box) else np.asarray(found["probabilities"])
    apart = difference(space, np.asarray(found["action"]), expected, probabilities, soft)
    if not apart <= TOLERANCE:
        raise UserError(
            f"the exported policy of {name} differs from the trained one by {apart:.2g} ({by} against JAX, "
            f"{len(seen):,} observations), more than {TOLERANCE:g}: nothing was written"
        )
    return apart


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values).max()) if np.isfinite(values).all() else np.inf
