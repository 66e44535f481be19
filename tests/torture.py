"""`python -m tests.torture minutes=N [seed=0] [key=value ...]`: kill and starve runs, damage their files, resume them.

Tiny runs are trained by processes of their own, which are killed (SIGKILL) or get errors at random ones of the calls
with which they change files, at named ones, or at random times; files of run directories are damaged; two processes are
started at once. Then the run is resumed: it must come to the unbroken run's numbers to the bit (metrics.csv and every
array of its last checkpoint), or say in one line what it cannot do. Prints a table of faults and outcomes; the exit
code is 1 where one was neither. Other words are settings of all runs, such as algo.actor=gru.
"""

import collections
import dataclasses
import functools
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "helpers"))

import faults  # noqa: E402
import numpy as np  # noqa: E402
from checkpoint_arrays import assert_same_arrays, assert_same_run, leaves  # noqa: E402
from disturbed import Ended, Job, Process  # noqa: E402

from matd3_jax import config  # noqa: E402
from matd3_jax.errors import UserError  # noqa: E402
from matd3_jax.runs.directory import RunDirectory  # noqa: E402
from matd3_jax.training import checkpoint  # noqa: E402

SETTINGS = [
    "env=point_reach", "algo=iddpg", "seeds=2", "learning_starts=200", "num_envs=4", "rollout_length=5",
    "batch_size=16", "replay_capacity=400", "algo.hidden=[8]", "log_every=100", "eval_every=0",
]  # fmt: skip
TRAIN = [*SETTINGS, "total_steps=600", "checkpoint_every=200", "keep_checkpoints=3"]
SWEEP = [*SETTINGS, "total_steps=400", "checkpoint_every=100", "algo.lr=0.01,0.001"]
SAME, SAID, LOST = "resumed to the same bits", "refused in one line", "LOST"
KINDS = 18
"""How many `Torture.trials` there are."""
ERRORS = slice(8, 14)
"""Those of errors and damaged files."""

UNNOTICED = "changed, without a checksum to notice"
Outcome = str


def resume(path: Path, *more: str) -> list[str]:
    return ["train", f"resume={path}", *more]


def lines(ended: Ended) -> list[str]:
    """The errors that a command has reported."""
    return [line for line in ended.output.splitlines() if line.startswith("error: ")]


def one_line(ended: Ended) -> bool:
    return ended.code == 2 and len(lines(ended)) == 1 and "Traceback" not in ended.output


def same(path: Path, whole: Path) -> str:
    """Where a run differs from the unbroken one; "" where it does not."""
    try:
        if (path / "metrics.csv").read_bytes() != (whole / "metrics.csv").read_bytes():
            return "metrics.csv differs"
        assert_same_arrays(leaves(path), arrays(whole))
        run = RunDirectory(path)
        left = [one.name for one in path.iterdir() if "partial" in one.name]
        left += [one.name for one in run.checkpoints.iterdir() if not one.name.isdigit()]
        if left:
            return f"left: {', '.join(left)}"
        return "" if run.summary() is not None and run.curve.exists() else "no summary or curve"
    except Exception as error:  # whatever it is, the run is not whole
        return f"{type(error).__name__}: {error}"


@functools.cache
def arrays(path: Path) -> dict[str, np.ndarray]:
    return leaves(path)


@dataclasses.dataclass
class Torture:
    """All trials, with what they share."""

    place: Path
    rng: random.Random
    settings: tuple[str, ...] = ()
    """Of all runs, besides the usual ones or in their place."""
    table: dict[tuple[str, str, Outcome], int] = dataclasses.field(default_factory=collections.Counter)
    failures: list[str] = dataclasses.field(default_factory=list)
    kills: int = 0
    injected: int = 0
    """Errors and short writes that commands got, and files damaged."""

    def __post_init__(self) -> None:
        self.process, self.other = Process(self.place), Process(self.place)
        self.whole, self.whole_sweep = self.place / "whole" / "run", self.place / "whole sweep" / "sweep"
        begun = time.monotonic()
        first = self.run(Job(self.train(self.whole), self.whole.parent))
        assert first.code == 0, first.output
        self.calls = first.calls
        again = self.place / "again" / "run"
        begun = time.monotonic()
        assert self.run(Job(self.train(again), again.parent)).code == 0
        self.seconds = time.monotonic() - begun
        assert same(again, self.whole) == ""
        swept = self.run(Job(self.sweep(self.whole_sweep), self.whole_sweep.parent))
        assert swept.code == 0, swept.output
        self.sweep_calls = swept.calls
        self.number = 0

    def train(self, path: Path) -> list[str]:
        return ["train", *config.merge(TRAIN, self.settings), f"out={path.parent}", f"name={path.name}"]

    def sweep(self, path: Path, *more: str) -> list[str]:
        return ["sweep", *config.merge(SWEEP, self.settings), f"out={path.parent}", f"name={path.name}", *more]

    def close(self) -> None:
        self.process.close()
        self.other.close()

    def run(self, job: Job) -> Ended:
        """Run a command, and count what hit it."""
        ended = self.process.run(job)
        if ended.code is None:
            self.kills += 1
        elif job.largest is not None or job.how in faults.INJECTED:
            self.injected += 1
        return ended

    def path(self, kind: str = "run") -> Path:
        """A new directory's, which has a folder to itself."""
        self.number += 1
        folder = self.place / f"trial{self.number}"
        folder.mkdir()
        return folder / kind

    def note(self, fault: str, ended: Ended | None, outcome: Outcome, detail: str = "") -> None:
        if ended is None:
            how = "-"
        elif ended.code is None:
            how = "killed"
        elif "Traceback" in ended.output or "Exception ignored" in ended.output:
            how, outcome, detail = "ended with a traceback", LOST, detail or ended.output[-1500:]
        elif ended.code > 128:
            how = "stopped by the signal"
        else:
            how = "came to its end" if ended.code == 0 else "ended with one line"
        self.table[fault, how, outcome] += 1
        if outcome == LOST:
            self.failures.append(f"{fault}: {detail}")
            print(f"LOST: {fault}: {detail}", flush=True)

    def start_or_resume(self, path: Path) -> Ended:
        """What a user does after a run ended before its time."""
        return self.run(Job(resume(path) if path.exists() else self.train(path), path.parent))

    def settle(self, fault: str, path: Path, ended: Ended) -> None:
        """Resume a run after a fault, and note whether it comes to the unbroken run's bits."""
        again = self.start_or_resume(path)
        if again.code == 2 and "raise total_steps=" in again.output:
            again = again._replace(code=0)  # it had come to its end before the fault
        wrong = again.output[-1500:] if again.code != 0 else same(path, self.whole)
        last = ended.calls[-1] if ended.calls else "-"
        self.note(fault, ended, LOST if wrong else SAME, f"after {last}: {wrong}")
        if not wrong:
            shutil.rmtree(path.parent)

    # ---- the faults ----------------------------------------------------------------------------------------------

    def kill_at_a_call(self) -> None:
        path, how = self.path(), self.rng.choice(["kill", "kill after", "half"])
        ended = self.run(Job(self.train(path), path.parent, how, self.rng.randrange(len(self.calls))))
        self.settle("SIGKILL at a random call", path, ended)

    def power_cut(self) -> None:
        """At a random call; of every file is left what was synced."""
        path = self.path()
        ended = self.run(Job(self.train(path), path.parent, "power", self.rng.randrange(len(self.calls))))
        self.settle("power cut at a random call", path, ended)

    def kill_at_a_time(self) -> None:
        path = self.path()
        ended = self.run(Job(self.train(path), path.parent, after=self.rng.uniform(0, 1.1 * self.seconds)))
        self.settle("SIGKILL at a random time", path, ended)

    def kill_there(self, fault: str, pattern: str, hows: tuple[str, ...]) -> None:
        path = self.path()
        at = self.rng.randrange(sum(bool(re.search(pattern, call)) for call in self.calls))
        ended = self.run(Job(self.train(path), path.parent, self.rng.choice(hows), at, pattern))
        self.settle(fault, path, ended)

    def kill_at_resumes(self) -> None:
        """Killed again and again, at the resumes too; once by an older checkpoint."""
        path = self.path()
        at = self.rng.randrange(len(self.calls) // 3, len(self.calls))
        ended = self.run(Job(self.train(path), path.parent, "kill", at))
        for _ in range(self.rng.randint(1, 3)):
            steps = checkpoint.steps(path / "checkpoints")
            more = [f"checkpoint={steps[0]}"] if len(steps) > 1 and self.rng.random() < 0.5 else []
            how = self.rng.choice(["kill", "kill after", "half"])
            if path.exists():
                ended = self.run(Job(resume(path, *more), path.parent, how, self.rng.randrange(40)))
        self.settle("SIGKILL at several resumes", path, ended)

    def error_at_a_call(self, how: str, calls: str) -> None:
        path = self.path()
        pattern = f"^({'|'.join(calls.split())}) "
        at = self.rng.randrange(sum(bool(re.search(pattern, call)) for call in self.calls))
        ended = self.run(Job(self.train(path), path.parent, how, at, pattern))
        self.settle({"short": "short write"}.get(how, how), path, ended)

    def signal_at_a_call(self) -> None:
        """A wish to stop, or two of them, wherever the run is."""
        path, how = self.path(), self.rng.choice(faults.SIGNALS)
        ended = self.run(Job(self.train(path), path.parent, how, self.rng.randrange(len(self.calls))))
        number = getattr(signal, how.split()[0])
        if ended.code not in (None, 0, 128 + number):  # killed: it came before the run heeds signals, or after
            return self.note(how, ended, LOST, f"exit code {ended.code}: {ended.output[-1500:]}")
        self.settle(how, path, ended)

    def file_limit(self) -> None:
        """No file may grow beyond some bytes: fails in Orbax's C++, too."""
        path = self.path()
        ended = self.run(Job(self.train(path), path.parent, largest=self.rng.choice([100, 1000, 3000, 6000, 12000])))
        self.settle("EFBIG (also in C++)", path, ended)

    def damage_a_checkpoint(self) -> None:
        """The last checkpoint: it is refused by name, the one before it leads to the same bits."""
        path = self.back()
        *_, before, last = checkpoint.steps(path / "checkpoints")
        file = self.rng.choice([one for one in (path / "checkpoints" / str(last)).rglob("*") if one.is_file()])
        what = self.damage(file)
        ended = self.run(Job(resume(path), path.parent))
        fault = f"checkpoint file {what}"
        if not (one_line(ended) and "is damaged" in ended.output and f"checkpoint={before}" in ended.output):
            return self.note(fault, None, LOST, f"{file.relative_to(path)}: {ended.output[-600:]}")
        again = self.run(Job(resume(path, f"checkpoint={before}"), path.parent))
        wrong = again.output[-600:] if again.code else same(path, self.whole)
        self.note(fault, ended, LOST if wrong else f"named; the checkpoint before it {SAME}", wrong)
        shutil.rmtree(path.parent)

    def damage_another_file(self) -> None:
        path = self.back()
        name = self.rng.choice(["metrics.csv", "config.yaml", "machine.json", ".lock"])
        (path / name).touch()
        what = self.damage(path / name)
        ended = self.run(Job(resume(path), path.parent))
        fault = f"{name} {what}"
        if ended.code == 0:
            wrong = same(path, self.whole)
            if not wrong or name == ".lock" or name == "machine.json":
                self.note(fault, None, LOST if wrong else SAME, wrong)
            elif "note: " in ended.output:
                self.note(fault, None, "resumed; the damaged or missing rows were named")
            else:
                self.note(fault, None, UNNOTICED if name == "config.yaml" else LOST, wrong)
        else:
            self.note(fault, None, SAID if one_line(ended) else LOST, ended.output[-600:])
        shutil.rmtree(path.parent)

    def two_at_once(self) -> None:
        path = self.back()
        ended = []
        for process in (self.process, self.other):
            process.begin(Job(resume(path), path.parent))
        for process in (self.process, self.other):
            ended.append(process.wait())
        codes = sorted(str(one.code) for one in ended)
        refused = [one for one in ended if one.code == 2]
        said = all(one_line(one) and re.search("is in use|raise total_steps=", one.output) for one in refused)
        wrong = f"exit codes {codes}" if codes != ["0", "2"] or not said else same(path, self.whole)
        outcome = LOST if wrong else "one refused in one line, the other to the same bits"
        self.note("two processes at once", None, outcome, wrong or "")
        shutil.rmtree(path.parent)

    def kill_a_plan(self) -> None:
        """A sweep that is killed while it plans is started again with the same command."""
        path = self.path("sweep")
        how = self.rng.choice(["kill", "kill after", "half"])
        ended = self.run(Job(self.sweep(path, "train=false"), path.parent, how, self.rng.randrange(self.planned() + 1)))
        again = self.run(Job(self.sweep(path, "train=false"), path.parent))
        if again.code == 2 and (path / "sweep.json").exists():
            again = again._replace(code=0)  # the plan was there already
        self.compare_sweeps("sweep killed while it plans", path, ended, again, trained=False)

    def kill_a_sweep(self) -> None:
        path = self.path("sweep")
        at = self.rng.randrange(self.planned() + 3, len(self.sweep_calls))
        ended = self.run(Job(self.sweep(path), path.parent, self.rng.choice(["kill", "kill after", "half"]), at))
        again = self.run(Job(["sweep", f"resume={path}"], path.parent))
        self.compare_sweeps("sweep killed while it trains", path, ended, again, trained=True)

    def compare_sweeps(self, fault: str, path: Path, ended: Ended, again: Ended, trained: bool) -> None:
        wrong = again.output[-1500:] if again.code else ""
        if not wrong:
            plans = [json.loads((folder / "batches.json").read_text()) for folder in (path, self.whole_sweep)]
            wrong = "" if plans[0] == plans[1] else "other batches"
            for name in (name for batch in plans[1] for name in batch):
                run, other = path / "runs" / name, self.whole_sweep / "runs" / name
                if trained:
                    wrong = wrong or _same_member(run, other)
                else:
                    wrong = wrong or ("" if (run / "config.yaml").exists() else f"{name} is not there")
            if trained and any((path / "batches").iterdir()):
                wrong = wrong or "a finished batch left its checkpoints"
        self.note(fault, ended, LOST if wrong else SAME if trained else "planned again, the same batches",
                  f"after {ended.calls[-1] if ended.calls else '-'}: {wrong}")  # fmt: skip
        if not wrong:
            shutil.rmtree(path.parent)

    # ---- what they share -----------------------------------------------------------------------------------------

    def back(self) -> Path:
        """A copy of the unbroken run as a kill before its last checkpoint would have left it."""
        path = shutil.copytree(self.whole, self.path())
        steps = checkpoint.steps(path / "checkpoints")
        shutil.rmtree(path / "checkpoints" / str(steps[-1]))
        for name in ("summary.json", "learning_curve.png"):
            (path / name).unlink()
        return path

    def planned(self) -> int:
        """Number of the call with which a sweep's plan is complete."""
        return next(k for k, call in enumerate(self.sweep_calls) if call == "replace sweep/sweep.json")

    def damage(self, file: Path) -> str:
        self.injected += 1
        data = bytearray(file.read_bytes())
        what = self.rng.choice(["with a bit flipped", "cut", "emptied", "deleted", "with zeros at its end"])
        if what == "deleted":
            file.unlink()
            return what
        if what == "with a bit flipped" and data:
            data[self.rng.randrange(len(data))] ^= 1 << self.rng.randrange(8)
        elif what == "cut" and data:
            del data[self.rng.randrange(len(data)) :]
        elif what == "emptied" and data:
            data.clear()
        else:
            what = "with zeros at its end"
            data += bytes(self.rng.randint(1, 4096))
        file.write_bytes(data)
        return what

    def trials(self) -> list[Callable[[], None]]:
        """One of each kind, in the order of a round."""
        there = functools.partial
        found = [
            self.kill_at_a_call, self.kill_at_a_time, self.power_cut,
            there(self.kill_there, "SIGKILL inside a checkpoint", r"checkpoints/\.", ("kill", "half")),
            there(self.kill_there, "SIGKILL as a checkpoint gets its name", r"^rename run/checkpoints/\d+$",
                  ("kill", "kill after")),
            there(self.kill_there, "SIGKILL within a row", r"^write run/metrics\.csv", ("half", "kill after")),
            there(self.kill_there, "SIGKILL at the end", r"learning_curve|summary", ("kill", "kill after", "half")),
            self.kill_at_resumes,
            there(self.error_at_a_call, "ENOSPC", "open write mkdir"),
            there(self.error_at_a_call, "EIO", "open write fsync replace rename"),
            there(self.error_at_a_call, "short", "write"),
            self.file_limit, self.damage_a_checkpoint, self.damage_another_file, self.two_at_once,
            self.kill_a_plan, self.kill_a_sweep, self.signal_at_a_call,
        ]  # fmt: skip
        assert len(found) == KINDS
        return found

    def report(self) -> str:
        """The table, as Markdown."""
        rows = ["| fault | the run it hit | outcome | trials |", "|---|---|---|---|"]
        rows += [f"| {' | '.join(key)} | {count} |" for key, count in sorted(self.table.items())]
        hit = f"{self.kills} kills (power cuts among them), {self.injected} injected faults"
        return "\n".join([*rows, "", f"{sum(self.table.values())} trials: {hit}, {len(self.failures)} lost"])


def _same_member(path: Path, whole: Path) -> str:
    """Where a run of a sweep, whose checkpoint has no replay, differs from the unbroken one."""
    try:
        assert_same_run(path, whole)
        return "" if RunDirectory(path).summary() is not None else f"{path.name}: no summary"
    except Exception as error:
        return f"{path.name}: {type(error).__name__}: {error}"


def main(argv: list[str]) -> int:
    """Trials for as long as is given; the exit code."""
    try:
        config.parse([text for text in argv if "=" not in text])  # raises for a word that is no key=value
        given = dict(text.split("=", 1) for text in argv)
        minutes, seed = float(given.pop("minutes", 5)), int(given.pop("seed", 0))
        settings = tuple(f"{key}={value}" for key, value in given.items())
        config.load(config.merge(TRAIN, settings))
    except (ValueError, UserError) as error:
        raise SystemExit(f"error: {error}; usage: minutes=N, seed=N, settings of all runs") from None
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    with tempfile.TemporaryDirectory(prefix="torture-") as folder:
        cache = Path(folder) / "compiled"
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
        torture = Torture(Path(folder), random.Random(seed), settings)
        try:
            end = time.monotonic() + 60 * minutes
            print(f"an unbroken run: {torture.seconds:.1f} s, {len(torture.calls)} calls that change files", flush=True)
            while time.monotonic() < end:
                trials = torture.trials()
                for trial in [*trials, *trials[ERRORS]]:  # errors twice: rounds have some more kills than errors
                    if time.monotonic() < end:
                        trial()
        finally:
            torture.close()
            print(torture.report(), flush=True)
    return 1 if torture.failures else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
