"""Env steps/s of the Ant: the whole loop of six seeds, its launches, and the physics alone over environments."""

from benchmarks import robots
from benchmarks.gpu import launches, timing
from benchmarks.gpu.report import Report, Row
from benchmarks.gpu.timing import Length

SEEDS, STEPS = 6, 1_000_000
"""The paper's: env steps of each seed."""


def run(report: Report, scale: float, length: Length) -> None:
    """What decides about the target comes first: the loop with physics=mjx."""
    few = length._replace(iterations=min(length.iterations, 5))
    seeds = SEEDS if scale >= 1 else 1
    # 20 environments are what HARL trains with.
    for num_envs in (128, 20, 1024) if scale >= 1 else (20,):
        report.case("ant", f"loop, mjx, {num_envs}", lambda n=num_envs: loop(seeds, n, few))
    # The same program as above, hence from the compilation cache.
    report.case("launches", "ant, 20 environments", lambda: launches.measure(settings(20, seeds), few))
    for physics, counts in (("mjx", (128, 1024, 8192)), ("mjx_fast", (1024, 8192))):
        for num_envs in counts if scale >= 1 else (4,):
            name = f"physics, {physics}, {num_envs}"
            report.case("ant", name, lambda p=physics, n=num_envs: physics_alone(p, n, few))


def settings(num_envs: int, seeds: int, physics: str = "mjx") -> list[str]:
    """100 replayed transitions for each env step, in minibatches of about 1,000."""
    return ["env=ant", f"env.physics={physics}", f"seeds={seeds}", *robots.schedule(num_envs)]


def loop(seeds: int, num_envs: int, length: Length) -> Row:
    row = timing.measure(settings(num_envs, seeds), "loop", length)
    return {"num_envs": num_envs, **row, "seconds_for_all": seeds * STEPS / row["env_steps_per_second"]}


def physics_alone(physics: str, num_envs: int, length: Length) -> Row:
    row = timing.measure(settings(num_envs, 1, physics), "environment", length)
    return {"num_envs": num_envs, "physics": physics, **row}
