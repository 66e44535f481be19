"""What `benchmarks.peers` compares: fixed here, so that nothing is picked once numbers are known."""

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Worker:
    """A script of this folder and where it runs."""

    script: str
    package: str
    """What it measures: the distribution whose version stands in the table."""
    requirements: tuple[tuple[str, ...], ...] = ()
    """For pip, call after call, in an environment of its own; none: this Python's."""
    cores: int = 0
    """Cores that it may use; 0: all."""


@dataclasses.dataclass(frozen=True)
class Variant:
    """One way to do the work."""

    worker: str
    """Key of `WORKERS`."""
    label: str
    case: dict[str, Any]
    """For the worker's script."""
    processes: int = 1
    """That many do the work side by side, each on its own; rates add up."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the table. Of several variants of a side the one with the highest median stands in it."""

    work: str
    ours: tuple[Variant, ...]
    peer: tuple[Variant, ...]


WORKERS = {
    "ours": Worker("ours_loop.py", "matd3_jax"),
    "ours, stepping": Worker("stepping_jax.py", "matd3_jax"),
    "ours, stepping on one core": Worker("stepping_jax.py", "matd3_jax", cores=1),
    "AgileRL": Worker(
        "agilerl_loop.py",
        "agilerl",
        # torch on its own and first: where a build for CPUs is at hand, the next call must not replace it. AgileRL
        # 2.58.0 imports peft without requiring it.
        (("torch==2.13.0",), ("torch==2.13.0", "agilerl==2.58.0", "mpe2==1.1.1", "peft==0.21.2")),
    ),
    # Needs gymnax, which needs an older gymnasium than ours.
    "JaxMARL": Worker("stepping_jax.py", "jaxmarl", (("jaxmarl==0.2.0", "jax==0.10.2"),)),
    "mpe2": Worker("stepping_python.py", "mpe2", cores=1),
    "gymnasium": Worker("stepping_python.py", "gymnasium", cores=1),
    # rejax 0.1.3 takes five values from an environment's step; gymnax 1.0 returns six.
    "rejax": Worker(
        "rejax_td3.py",
        "rejax",
        (("rejax==0.1.3", "gymnax==0.0.9", "brax==0.14.2", "mujoco==3.17.0", "jax==0.10.2"),),
    ),
}


def groups(cores: int) -> dict[str, list[Row]]:
    """The rows by the name that `only=` takes; `cores`: how many processes of a peer run side by side."""
    return {
        "agilerl": [row for name in ("matd3", "maddpg") for row in _agilerl(name, cores)],
        "jaxmarl": [_jaxmarl(n, steps) for n, steps in ((1, 10_000), (100, 1000), (10_000, 25))],
        "mpe2": _mpe2(),
        "gymnasium": [row for physics in ("c", "mjx", "mjx_fast") for row in _ant(physics)],
        "rejax": [_rejax(1, 1, 100), _rejax(10, 1, 20), _rejax(1, 128, 256)],
    }


# ---- whole loops -----------------------------------------------------------------------------------------------------


def _agilerl(algorithm: str, cores: int) -> list[Row]:
    """simple_spread at the paper's settings, mpe2's rules and hard choices on both sides."""
    shared = {"hidden": [64, 64], "batch_size": 1024, "capacity": 100_000, "learn_every": 100, "episode_length": 25}

    def ours(seeds: int, one_minibatch: bool) -> tuple[Variant, ...]:
        settings = [
            *("env=simple_spread", "env.num_agents=3", "env.rules=mpe2", "env.actions=discrete"),
            *(f"env.episode_length={shared['episode_length']}", f"algo={algorithm}", "algo.hidden=[64,64]"),
            *("num_envs=4", "rollout_length=25", "updates_per_collect=1", f"batch_size={shared['batch_size']}"),
            *(f"replay_capacity={shared['capacity']}", "learning_starts=2000", f"seeds={seeds}"),
            f"shared_minibatch={str(one_minibatch).lower()}",
        ]
        label = f"{seeds} seed{'s' if seeds > 1 else ''}"
        return (Variant("ours", label, {"settings": settings, "steps": 2000 if seeds == 1 else 600}),)

    def peer(counts: tuple[int, ...], threads: tuple[int, ...], processes: int) -> tuple[Variant, ...]:
        return tuple(
            Variant(
                "AgileRL",
                f"{f'{processes} processes, ' if processes > 1 else ''}{_count(n, 'environment')}, "
                f"{_count(t, 'thread')}",
                {"algorithm": algorithm.upper(), "num_envs": n, "threads": t, **shared},
                processes,
            )
            for t in threads
            for n in counts
        )

    name = f"{algorithm.upper()} on simple_spread"
    alone, together = peer((1, 4, 10), (1, 2), 1), peer((1, 4), (1,), cores)
    return [
        Row(f"{name}, one minibatch for all agents, 1 seed", ours(1, True), alone),
        Row(f"{name}, one minibatch for all agents, seeds at once", ours(10, True), together),
        Row(f"{name}, a minibatch for each agent (ours only), 1 seed", ours(1, False), alone),
        Row(f"{name}, a minibatch for each agent (ours only), seeds at once", ours(10, False), together),
    ]


def _rejax(seeds: int, num_envs: int, steps: int) -> Row:
    """TD3 on brax's hopper with rejax's default batch, replay and hidden layers."""
    case = {"seeds": seeds, "num_envs": num_envs, "batch_size": 256, "capacity": 131_072}
    settings = [
        *("env=brax_hopper", "env.backend=spring", "algo=td3", "algo.hidden=[64,64]", "algo.policy_delay=2"),
        *(f"num_envs={num_envs}", "rollout_length=1", f"updates_per_collect={num_envs}", "batch_size=256"),
        *("replay_capacity=131072", "learning_starts=2048", f"seeds={seeds}"),
    ]
    label = f"{_count(seeds, 'seed')}, {_count(num_envs, 'environment')}"
    ours = {"settings": settings, "steps": max(num_envs * 2, 1000 // seeds)}
    return Row(
        f"TD3 on brax's hopper, an update for each env step, {label}",
        (Variant("ours", label, ours),),
        (Variant("rejax", label, {**case, "steps": steps}),),
    )


# ---- stepping alone --------------------------------------------------------------------------------------------------


def _stepping(worker: str, num_envs: int, steps: int, env: str, **options: Any) -> Variant:
    case = {"suite": "ours", "env": env, "options": options, "num_envs": num_envs, "steps": steps}
    return Variant(worker, _count(num_envs, "environment"), case)


def _spread(worker: str, num_envs: int, steps: int) -> Variant:
    options = {"num_agents": 3, "rules": "mpe2", "actions": "discrete", "episode_length": 25}
    return _stepping(worker, num_envs, steps, "simple_spread", **options)


def _jaxmarl(num_envs: int, steps: int) -> Row:
    options = {"num_agents": 3, "num_landmarks": 3, "max_steps": 25}
    case = {"suite": "jaxmarl", "env": "MPE_simple_spread_v3", "options": options}
    label = _count(num_envs, "environment")
    return Row(
        f"simple_spread, stepping alone, {label}",
        (_spread("ours, stepping", num_envs, steps),),
        (Variant("JaxMARL", label, {**case, "num_envs": num_envs, "steps": steps}),),
    )


def _mpe2() -> list[Row]:
    peer = (Variant("mpe2", "1 environment", {"suite": "mpe2", "steps": 500}),)
    worker, name = "ours, stepping on one core", "simple_spread, stepping alone on one core"
    return [
        Row(f"{name}, 1 environment", (_spread(worker, 1, 10_000),), peer),
        Row(f"{name}, best batch", tuple(_spread(worker, n, steps) for n, steps in ((100, 1000), (10_000, 25))), peer),
    ]


def _ant(physics: str) -> list[Row]:
    def ours(num_envs: int) -> Variant:
        options = {"physics": physics, "split": "single", "episode_length": 1000}
        return _stepping("ours, stepping on one core", num_envs, max(2, 256 // num_envs), "ant", **options)

    peer = (Variant("gymnasium", "1 environment", {"suite": "gymnasium", "steps": 500}),)
    name = f"Ant (physics={physics}), stepping alone on one core"
    return [
        Row(f"{name}, 1 environment", (ours(1),), peer),
        Row(f"{name}, best batch", (ours(16), ours(256)), peer),
    ]


def _count(n: int, noun: str) -> str:
    return f"{n:,} {noun}{'' if n == 1 else 's'}"
