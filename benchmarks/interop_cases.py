"""What `benchmarks.interop` measures: other libraries' environments in our loop, and in the loop their own users write.

A case is a line of `CASES`. What it needs beyond this project's dependencies is imported when it is measured.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

Block = Callable[[], int]
"""Plays some env steps: how many."""


class Case(NamedTuple):
    """An environment of another library."""

    name: str
    settings: tuple[str, ...]
    """The run of ours that has it, as `matd3_jax.train` takes them."""
    own: Callable[[int], Block]
    """The library's own loop with random actions; takes the env steps of a block."""
    packages: tuple[str, ...]
    """Whose versions count."""


def parallel(module: str, steps: int, **kwargs: Any) -> Block:
    """PettingZoo's: one environment, `reset` and `step` in a Python loop."""
    from matd3_jax.envs.host import sources

    env = sources.named("env.id", module, "a module").parallel_env(**kwargs)
    env.reset(seed=0)

    def block() -> int:
        for _ in range(steps):
            if not env.agents:
                env.reset()
            env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        return steps

    return block


def single(name: str, steps: int) -> Block:
    """gymnasium's: one environment as `gymnasium.make` makes it, in a Python loop."""
    import gymnasium

    env = gymnasium.make(name, disable_env_checker=True)
    env.reset(seed=0)

    def block() -> int:
        for _ in range(steps):
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()
        return steps

    return block


def settings(env: str, name: str, *others: str, **kwargs: str | int) -> tuple[str, ...]:
    """Settings of a run with the environment `name`, made with `kwargs`."""
    given = [f"env.kwargs.{key}={value}" for key, value in kwargs.items()]
    return (f"env={env}", f"env.id={name}", *given, *others)


ANT: Mapping[str, str | int] = {"scenario": "Ant", "agent_conf": "2x4"}

CASES = (
    Case(
        "mpe2 simple_spread_v3",
        settings("pettingzoo", "mpe2.simple_spread_v3"),
        partial(parallel, "mpe2.simple_spread_v3"),
        ("pettingzoo", "mpe2"),
    ),
    Case(
        "mpe2 simple_tag_v3",
        settings("pettingzoo", "mpe2.simple_tag_v3"),
        partial(parallel, "mpe2.simple_tag_v3"),
        ("pettingzoo", "mpe2"),
    ),
    Case(
        "MaMuJoCo Ant 2x4",
        settings("pettingzoo", "gymnasium_robotics.mamujoco_v1", **ANT),
        partial(parallel, "gymnasium_robotics.mamujoco_v1", **ANT),
        ("gymnasium-robotics", "mujoco"),
    ),
    Case(
        "gymnasium Ant-v5, 2x4",
        settings("gymnasium", "Ant-v5", "env.split=2x4"),
        partial(single, "Ant-v5"),
        ("gymnasium", "mujoco"),
    ),
    Case(
        "gymnasium CartPole-v1",
        settings("gymnasium", "CartPole-v1", "recipe=paper"),
        partial(single, "CartPole-v1"),
        ("gymnasium",),
    ),
)
