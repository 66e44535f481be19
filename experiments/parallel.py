"""`python -m experiments.parallel runs=DIR out=DIR`: the studies of the particle tasks, several at once.

For a machine with room: an accelerator that one training does not fill, or many cores. Each part of a study (its
settings of one task) is trained by a process of its own, `processes` at a time, and after the four pairings of a
competitive task every team plays every opponent (`matd3_jax.crossplay`). What is finished in the end goes into the
results of the studies; the same command trains the rest.
"""

import dataclasses
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from experiments import collecting, study
from experiments.all import STUDIES
from experiments.study import RESULTS
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option, others
from matd3_jax.runs.paths import check_directory
from matd3_jax.runtime import devices, signals
from matd3_jax.runtime.terminal import say

PARTS: dict[str, tuple[str, ...]] = {
    "competitive": ("simple_tag-*", "simple_push-*", "simple_adversary-*", "simple_crypto-*"),
    "cooperative": ("simple_spread-*", "simple_speaker_listener-*"),
    "policy_delay": ("simple_spread-*", "simple_crypto-*"),
    "target_smoothing": ("*",),
    "number_of_agents": tuple(f"simple_spread{number}-*" for number in (6, 5, 4, 3, 2)),
    "grid_search": ("*-batch1000-*", "*-batch256-*"),
    "overestimation": ("*",),
}
"""Patterns of settings that a process trains, in the order in which they are begun."""


@dataclasses.dataclass(frozen=True)
class ParallelOptions:
    """Options of the studies side by side."""

    runs: Path = option("a folder for the run directories and the data of each part")
    out: Path = option("the folder of the studies' results", default=RESULTS)
    processes: int = option("parts at once; memory and cores are shared out among them", default=4, least=1, most=64)
    minutes: float = option("after which what runs is ended", default=600.0, unit="minutes", above=0)
    skip: tuple[str, ...] = option("studies to leave out", default=(), choices=tuple(PARTS), metavar="[NAME,NAME,...]")
    cross_play: bool = option("play every team against every opponent of the competitive tasks", default=True)
    episodes: int = option("of each pair in cross-play", default=100, least=1)
    rest: tuple[str, ...] = others("an option of all studies (scale=, seeds=, ...), or a setting of all")


COMMAND = Command(
    "python -m experiments.parallel",
    ParallelOptions,
    __doc__,
    examples=("python -m experiments.parallel runs=runs/paper processes=4 checkpoint_every=0 checkpoint_minutes=0",),
)


class Part:
    """A part of a study and its process."""

    def __init__(self, name: str, arguments: Sequence[str], folder: Path):
        self.name, self.arguments = name, list(arguments)
        self.log = folder / "logs" / f"{name}.log"
        self.process: subprocess.Popen | None = None
        self.begun = 0.0

    def start(self, environment: Mapping[str, str]) -> None:
        self.log.parent.mkdir(parents=True, exist_ok=True)
        self.begun = time.monotonic()
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", *self.arguments], env={**environment}, stdin=subprocess.DEVNULL,
                stdout=log, stderr=subprocess.STDOUT,
            )  # fmt: skip

    def ended(self) -> bool:
        assert self.process is not None
        return self.process.poll() is not None

    @property
    def code(self) -> int | None:
        return None if self.process is None else self.process.returncode

    def stop(self, seconds: float = 60) -> None:
        """End it as a signal does, with a checkpoint where it writes any; kill it after `seconds`."""
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(seconds)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    check_directory(options.runs, "runs")
    check_directory(options.out, "out")
    names = [name for name in PARTS if name not in options.skip]
    study.check_some([STUDIES[name] for name in names], options.rest)  # a mistake shows before anything starts
    stop = signals.Stop()
    parts = list(_parts(names, options))
    ended = _run(parts, options, stop)
    _merge(names, options)
    failed = [part for part in ended if part.code]
    for part in failed:
        say(f"{part.name}: exit code {part.code}, {_last_line(part.log)} ({part.log})")
    left = [part.name for part in parts if part.code is None or part.code < 0]
    if left:
        say(f"not finished: {', '.join(left)}")
    return 1 if failed or left else 0


def _parts(names: Sequence[str], options: ParallelOptions) -> Iterator[Part]:
    """All parts; each begins with the results there are, so that what is finished is not trained again."""
    for name in names:
        results = _results(name, options)
        for number, pattern in enumerate(PARTS[name]):
            label = f"{name}-{number}"
            data = options.runs / "data" / label
            if results.is_dir() and not data.exists():
                shutil.copytree(results, data, ignore=shutil.ignore_patterns("cross_play_*"))
            line = [f"experiments.{name}", f"only={pattern}", f"runs={options.runs / 'runs' / label}"]
            yield Part(label, [*line, f"out={data}", *options.rest], options.runs)


def _results(name: str, options: ParallelOptions) -> Path:
    """The folder of a study's results."""
    one = STUDIES[name]
    return options.out / study.folders(one, study.parse(one, options.rest))[1].name


def _environment(processes: int) -> dict[str, str]:
    """Of a process that shares the machine. What the user has set stands."""
    shared = {
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 / processes:.3f}",
        # TF32 products, an accelerator's default, change an update by a tenth of its length (docs/performance.md).
        "JAX_DEFAULT_MATMUL_PRECISION": "highest",
        "JAX_NUM_CPU_DEVICES": str(max(1, devices.cores() // processes)),
        "PYTHONUNBUFFERED": "1",
    }
    return {**shared, **os.environ}


def _run(parts: Sequence[Part], options: ParallelOptions, stop: signals.Stop) -> list[Part]:
    """Run the parts, and cross-play after its part: those that ended."""
    environment = _environment(options.processes)
    end = time.monotonic() + 60 * options.minutes
    waiting, running, ended = list(parts), [], []
    while (waiting or running) and time.monotonic() < end and stop.signal is None:
        for part in [part for part in running if part.ended()]:
            running.remove(part)
            ended.append(part)
            say(f"{part.name}: {'finished' if part.code == 0 else f'exit code {part.code}'} "
                f"after {time.monotonic() - part.begun:.0f} s")  # fmt: skip
            if options.cross_play and part.name.startswith("competitive-") and part.code == 0:
                waiting[:0] = _cross_play(part.name, options)
        while waiting and len(running) < options.processes:
            running.append(waiting.pop(0))
            running[-1].start(environment)
            say(f"{running[-1].name}: started")
        time.sleep(0.2)
    for part in running:
        part.stop()
    return ended


def _cross_play(name: str, options: ParallelOptions) -> list[Part]:
    """The cross-play of a competitive task's runs; none where it is there already."""
    folder = options.runs / "runs" / name / "runs"
    runs = sorted(folder.iterdir()) if folder.is_dir() else []
    if not runs:  # they were trained elsewhere
        return []
    out = _results("competitive", options) / f"cross_play_{runs[0].name.split('-')[0]}"
    if out.exists():
        return []
    line = ["matd3_jax.crossplay", f"runs={','.join(map(str, runs))}", f"out={out}", f"episodes={options.episodes}"]
    return [Part(f"cross_play-{name}", line, options.runs)]


def _merge(names: Sequence[str], options: ParallelOptions) -> None:
    """Take the parts' data into the studies' results, and report these."""
    for name in names:
        one = STUDIES[name]
        out = _results(name, options)
        data = collecting.read(out / one.data, out / "runs.json", one.keys)
        changed = False
        for number in range(len(PARTS[name])):
            folder = options.runs / "data" / f"{name}-{number}"
            part = collecting.read(folder / one.data, folder / "runs.json", one.keys)
            for label, rows in part.rows.items():
                changed |= data.offer(label, rows, part.facts[label])
        if changed:
            out.mkdir(parents=True, exist_ok=True)
            collecting.write(data, out / one.data, out / "runs.json")
            study.run(one, [*options.rest, "train=false", f"out={out}", f"runs={options.runs / 'none'}"])


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "without a word"


if __name__ == "__main__":
    command.run(main, COMMAND)
