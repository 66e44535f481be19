"""Running mean and variance of observations, and observations in units of them."""

from typing import NamedTuple

import chex
import jax.numpy as jnp

from matd3_jax.core.agents import JointLayout

CLIP = 10.0
"""Bound of normalized entries: one that hardly ever moves must not flood a network when it does."""
LEAST_VARIANCE = 1e-8
"""Added to variances, for entries that are constant."""


class Statistics(NamedTuple):
    """Of the joint observations x that one seed has acted on, warm-up included."""

    mean: chex.Array
    """[observation_size]"""
    variance: chex.Array
    """[observation_size]"""


def initial(size: int) -> Statistics:
    """Before anything is collected: observations stay as they are, but for the bound."""
    return Statistics(jnp.zeros(size), jnp.ones(size))


def merge(statistics: Statistics, x: chex.Array, rollouts: chex.Array) -> Statistics:
    """Statistics with x [rows, observation_size] of one more rollout, after `rollouts` of the same size (pairwise
    update of Chan, Golub and LeVeque 1983).

    Means of means and of variances instead of sums: nothing grows, and float32 lasts for any number of env steps.
    """
    share = 1 / (rollouts + 1.0)
    mean, variance = x.mean(axis=0), x.var(axis=0)
    delta = mean - statistics.mean
    return Statistics(
        statistics.mean + share * delta,
        (1 - share) * (statistics.variance + share * jnp.square(delta)) + share * variance,
    )


def floored(statistics: Statistics, deviation: float) -> Statistics:
    """Statistics with standard deviations of at least `deviation`: entries that hardly ever move (contact forces) then
    stay small when they do, instead of filling the range that others have."""
    return statistics._replace(variance=jnp.maximum(statistics.variance, deviation**2))


def normalize(statistics: Statistics, x: chex.Array) -> chex.Array:
    """(x - mean) / standard deviation, within +-10, of joint observations x [..., observation_size]."""
    scaled = (x - statistics.mean) / jnp.sqrt(statistics.variance + LEAST_VARIANCE)
    return jnp.clip(scaled, -CLIP, CLIP)


def normalize_part(layout: JointLayout, statistics: Statistics, observation: chex.Array, agent: int) -> chex.Array:
    """The same of one agent's observations o_i [..., observation_sizes[agent]]."""
    return normalize(Statistics(*(layout.observation_part(part, agent) for part in statistics)), observation)


def normalize_rows(layout: JointLayout, statistics: Statistics, rows: chex.Array) -> chex.Array:
    """The same of x and x' in replay rows [..., row_size]."""
    for columns in layout.observation_columns:
        rows = rows.at[..., columns].set(normalize(statistics, rows[..., columns]))
    return rows
