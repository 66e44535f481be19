"""`python -m benchmarks.guard`: has speed or memory of the whole loop got far worse than recorded?

simple_spread, four seeds at the paper's settings with a replay of 100,000 transitions. Only ratios are compared, each
of things measured in turns within this run, so that another machine or other work on it makes little difference: the
loop's time over the least that its matrix products could take, the time of rollouts over the loop's, the program's
memory over the replay's. Exit code 1, and one line that names the broken bounds (`BOUNDS`, each with its reason).
`record=true` writes what was measured into benchmarks/guard.json, to compare with from then on. Under a minute on two
CPU cores.
"""

import dataclasses
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks import throughput
from benchmarks.commit import commit
from benchmarks.loop import Loop, copies_in
from matd3_jax import config
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.errors import UserError
from matd3_jax.runtime import devices, files
from matd3_jax.runtime.terminal import complain, say

RECORDED = Path(__file__).with_suffix(".json")
SETTINGS = ("env=simple_spread", "seeds=4", "replay_capacity=100000", "total_steps=100000", "eval_every=0")
ROUNDS = 5


class Bound(NamedTuple):
    """A ratio may reach `factor` times what was recorded, plus `slack`, and not go beyond."""

    meaning: str
    factor: float
    slack: float = 0.0

    def limit(self, recorded: float) -> float:
        return self.factor * recorded + self.slack


BOUNDS = {
    # Nine runs on a core that up to five other programs were at all the time: medians 1.88 to 2.10 with one device or
    # two, single turns 1.2 to 2.5. Half the speed is beyond all of that.
    "loop_over_floor": Bound("time of the whole loop over that of its products at the machine's rate", 2.0),
    # Medians of 0.013 to 0.018 in the same runs (one turn: 0.49): so little that twice as much would hardly show in the
    # loop, hence the slack.
    "rollout_share": Bound("time of the rollouts over that of the whole loop", 2.0, 0.05),
    # Counted by the compiler, so always the same; one device or two differ by 0.05. A copy of the replay adds 1.
    "memory_over_replay": Bound("memory of the compiled interval over that of the replay", 1.0, 0.5),
    # None is the only number that will do.
    "replay_copies": Bound("copies of the whole replay in the compiled interval", 1.0),
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of this benchmark."""

    record: bool = option("true: write what is measured into benchmarks/guard.json", default=False)


COMMAND = Command("python -m benchmarks.guard", Options, __doc__)


def main(argv: Sequence[str]) -> int:
    record = COMMAND.parse(argv).record
    begun = time.monotonic()
    devices.prepare()
    platform = jax.default_backend()
    found = json.loads(RECORDED.read_text(encoding="utf-8")) if RECORDED.exists() else {}
    if not record and platform not in found:
        raise UserError(f"{RECORDED} holds nothing for {platform}: record it with record=true")
    ratios, spread = measure()
    if record:
        about = {"machine": devices.description(), "versions": devices.versions(), "commit": commit()}
        found[platform] = {**about, "ratios": ratios, "in_turns": spread}
        files.write_json(RECORDED, found)
        say(f"written to {RECORDED}")
    recorded = found[platform]["ratios"]
    for key, bound in BOUNDS.items():
        turns = " ({:.3g} to {:.3g} in turns)".format(*spread[key]) if key in spread else ""
        say(f"{bound.meaning}: {ratios[key]:.3g}{turns}; recorded {recorded[key]:.3g}, "
              f"at most {bound.limit(recorded[key]):.3g}")  # fmt: skip
    say(f"took {time.monotonic() - begun:.0f} s")
    broken = failures(ratios, recorded)
    if broken:
        complain(f"guard: much worse than recorded: {'; '.join(broken)}")
    return 1 if broken else 0


def failures(ratios: Mapping[str, float], recorded: Mapping[str, float]) -> list[str]:
    """What to say of each ratio beyond its bound; one that is not a number is beyond it."""
    return [
        f"{bound.meaning} {ratios[key]:.3g}, at most {bound.limit(recorded[key]):.3g} ({recorded[key]:.3g} recorded)"
        for key, bound in BOUNDS.items()
        if not ratios[key] <= bound.limit(recorded[key])
    ]


def measure() -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """(ratio by key of `BOUNDS`, lowest and highest of those that were measured in turns)."""
    loop = Loop(config.load(SETTINGS))
    trainer = loop.trainer
    calls = loop.calls(0.4)
    rates, loops, rollouts = [throughput.matmul_gflops(2)], [], []
    for _ in range(ROUNDS):
        loops.append(loop.iteration_seconds(calls))
        begun = time.perf_counter()
        loop.state, _ = jax.block_until_ready(trainer.warm_up(loop.state))
        each = (time.perf_counter() - begun) / trainer.schedule.warmup_rollouts
        rollouts.append(trainer.rollouts_per_iteration * each)
        rates.append(throughput.matmul_gflops(2))
    around = (np.array(rates[1:]) + np.array(rates[:-1])) / 2
    in_turns = {
        "loop_over_floor": np.array(loops) / roofline_seconds(loop, around),
        "rollout_share": np.array(rollouts) / np.array(loops),
    }
    memory = loop.memory()
    ratios = {key: float(np.median(values)) for key, values in in_turns.items()}
    ratios["memory_over_replay"] = memory["xla"] / memory["replay"]
    ratios["replay_copies"] = copies_in(loop.compiled.as_text(), trainer)
    rounded = {key: round(value, 4) for key, value in ratios.items()}
    return rounded, {k: (round(float(v.min()), 4), round(float(v.max()), 4)) for k, v in in_turns.items()}


def roofline_seconds(loop: Loop, gflops: Any) -> Any:
    """The least time that an iteration's matrix products take where all devices together do `gflops` (an array,
    too)."""
    return loop.iteration_flops / 1e9 / gflops


if __name__ == "__main__":
    sys.argv[0] = "guard"
    command.run(main, COMMAND)
