"""`python -m benchmarks.sharing`: what networks in common save: MATD3 with many agents, four ways, measured in turns.

simple_spread with each number of agents at the settings of `benchmarks.growth` (a full replay of `replay` transitions).
"apart": each agent has its own actor and critics; "kind": share_parameters=kind; "team": critic=shared; "both". Other
keys are settings of the run, for all four: with shared_minibatch=true "apart" and "kind" have one minibatch, too, as a
team with one set of critics always has. Each measurement is a process of its own (`benchmarks.loop`); the four follow
each other, `turns` times. Env steps/s, updates/s (of all agents together) and seconds to compile: medians over the
turns, with the slowest and the fastest. Bytes: networks and optimizers of a seed, and what XLA counts for the compiled
interval of all seeds.
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import fresh, growth
from benchmarks.commit import commit
from benchmarks.options import OfARun
from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say
from matd3_jax.training import memory
from matd3_jax.training.session import TrainingSession

MODES: dict[str, list[str]] = {
    "apart": [],
    "kind": ["algo.share_parameters=kind"],
    "team": ["algo.critic=shared"],
    "both": ["algo.share_parameters=kind", "algo.critic=shared"],
}


@dataclasses.dataclass(frozen=True)
class Options(OfARun):
    """Options of this benchmark."""

    agents: tuple[int, ...] = option("numbers of agents", default=(12, 24), least=1)
    few_seeds: int = option("seeds of each run", default=2, least=1)
    replay: int = option("transitions that a replay keeps", default=10_000, least=1)
    turns: int = option("measurements of each", default=5, least=1)
    seconds: float = option("length of a measurement", default=5.0, unit="seconds", above=0)


COMMAND = Command("python -m benchmarks.sharing", Options, __doc__)


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    report: dict[str, Any] = {"versions": devices.versions(), "commit": commit(), "settings": list(argv)}
    lines = {(n, mode): settings(n, mode, options) for n in options.agents for mode in MODES}
    state = {key: state_bytes(line) for key, line in lines.items()}
    turns: dict[tuple[int, str], list[dict[str, Any]]] = {key: [] for key in lines}
    for turn in range(options.turns):
        for key, line in lines.items():
            turns[key].append(fresh.run("benchmarks.loop", ["repeats=1", f"seconds={options.seconds}", *line]))
        say(f"turn {turn + 1} of {options.turns} measured")
    report["machine"] = next(iter(turns.values()))[0]["machine"]
    report["rows"] = [
        {"agents": n, "mode": mode, "state_bytes": state[n, mode], **summary(measured, options.few_seeds)}
        for (n, mode), measured in turns.items()
    ]
    say("\n".join(table(report["rows"])))
    options.write(report)
    return 0


def settings(agents: int, mode: str, options: Options) -> list[str]:
    """Settings of a run."""
    point = {"seeds": options.few_seeds, **growth.BASE, "agents": agents, "replay": options.replay}
    return [*growth.settings(point), *MODES[mode], *options.overrides]


def state_bytes(line: Sequence[str]) -> int:
    """Bytes of the networks and optimizers of one seed."""
    trainer = TrainingSession(config.load(line)).trainer
    return memory.size(trainer.abstract_state().groups) // trainer.sharding.padded_seeds


def summary(turns: Sequence[Mapping[str, Any]], seeds: int) -> dict[str, float]:
    """Medians over the turns of one setting, with the slowest and the fastest env steps/s."""
    rates = [turn["env_steps_per_second"] for turn in turns]
    updates = [seeds * turn["updates_of_a_cycle"] / turn["cycle_seconds"] for turn in turns]
    return {
        "env_steps_per_second": float(np.median(rates)),
        "slowest": min(rates),
        "fastest": max(rates),
        "updates_per_second": float(np.median(updates)),
        "compile_seconds": float(np.median([turn["compile_seconds"] for turn in turns])),
        "xla_bytes": int(np.median([turn["memory"]["xla"] for turn in turns])),
    }


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The rows for people, rates beside those of "apart" with as many agents."""
    lines = [
        f"{'agents':>6} {'mode':<6} {'env steps/s':>11} {'slowest':>8} {'fastest':>8} {'to apart':>8} {'updates/s':>9} "
        f"{'state, MB':>9} {'XLA, MB':>8} {'compiled in':>11}"
    ]
    for row in rows:
        apart = next(one for one in rows if one["agents"] == row["agents"] and one["mode"] == "apart")
        lines.append(
            f"{row['agents']:>6} {row['mode']:<6} {row['env_steps_per_second']:>11,.0f} {row['slowest']:>8,.0f} "
            f"{row['fastest']:>8,.0f} {row['env_steps_per_second'] / apart['env_steps_per_second']:>8.2f} "
            f"{row['updates_per_second']:>9,.1f} {row['state_bytes'] / 1e6:>9,.2f} {row['xla_bytes'] / 1e6:>8,.0f} "
            f"{row['compile_seconds']:>9.1f} s"
        )
    return lines


if __name__ == "__main__":
    sys.argv[0] = "sharing"
    command.run(main, COMMAND)
