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


COMPILED = 32
"""Environments side by side in the own loops of libraries in JAX: as many as ours has with two devices."""


def jaxmarl(name: str, steps: int, **kwargs: Any) -> Block:
    """JaxMARL's: `step`, which resets by itself, vmapped over environments and scanned over env steps."""
    import jax

    from matd3_jax.interop.import_jaxmarl import import_jaxmarl

    env = import_jaxmarl("this benchmark").make(name, **kwargs)

    def step(key: Any, state: Any) -> Any:
        keys = jax.random.split(key, len(env.agents) + 1)
        actions = {a: env.action_space(a).sample(k) for a, k in zip(env.agents, keys[1:], strict=True)}
        observations, state, rewards, *_ = env.step(keys[0], state, actions)
        return state, (observations, rewards)

    return _scanned(lambda keys: jax.vmap(env.reset)(keys)[1], jax.vmap(step), steps)


def playground(name: str, steps: int) -> Block:
    """Playground's: as its trainers wrap a task, which then resets by itself, scanned over env steps."""
    import jax
    from mujoco_playground import registry, wrapper

    task = registry.load(name, config_overrides={"impl": "jax"})
    env = wrapper.wrap_for_brax_training(task, episode_length=registry.get_default_config(name).episode_length)

    def step(keys: Any, state: Any) -> Any:
        action = jax.random.uniform(keys[0], (COMPILED, task.action_size), minval=-1.0)
        state = env.step(state, action)
        return state, (state.obs, state.reward)

    return _scanned(env.reset, step, steps)


def _scanned(reset: Callable[[Any], Any], step: Callable[[Any, Any], Any], steps: int) -> Block:
    """`COMPILED` environments; all that is seen goes into the result, so that nothing can be left out."""
    import jax

    def one(carry: Any, _: None) -> Any:
        key, state = carry
        key, now = jax.random.split(key)
        state, seen = step(jax.random.split(now, COMPILED), state)
        return (key, state), sum(leaf.sum() for leaf in jax.tree.leaves(seen))

    play = jax.jit(lambda carry: jax.lax.scan(one, carry, length=steps))
    key = jax.random.PRNGKey(0)
    kept = [(key, jax.jit(reset)(jax.random.split(key, COMPILED)))]

    def block() -> int:
        carry, _ = jax.block_until_ready(play(kept.pop()))
        kept.append(carry)
        return COMPILED * steps

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
    Case(
        "JaxMARL simple_spread_v3",
        settings("jaxmarl", "MPE_simple_spread_v3"),
        partial(jaxmarl, "MPE_simple_spread_v3"),
        ("jaxmarl",),
    ),
    Case(
        "Playground CheetahRun, 2x3",
        settings("playground", "CheetahRun", "env.split=2x3"),
        partial(playground, "CheetahRun"),
        ("playground", "mujoco-mjx"),
    ),
)
