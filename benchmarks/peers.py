"""`python -m benchmarks.peers`: env steps/s of this trainer and of other programs that do the same work, in one run.

Peers that can be installed with this package are so by its extra `peers`; the others get virtual environments under
`envs` (default: peers in the cache folder). The rows are fixed (`benchmarks/peers_scripts/rows.py`); `only` leaves out
whole peers. Everything runs on the CPU, and never two sides at once: in each turn every way to do the work is measured
for `seconds` (compilation left out), ours and the peer's one after the other, the order reversed from turn to turn. A
row gives medians over the turns with the lowest and the highest; the ratio is that of the same turn. Where a side can
do the work in several ways (environments, threads, batch), the one with the highest median stands in the table, and
all of them in the JSON. A peer that fails stands there with its error. The markdown table comes last.
"""

import dataclasses
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import throughput
from benchmarks.commit import commit
from benchmarks.options import Reported
from benchmarks.peers_scripts import process, rows
from benchmarks.peers_scripts.process import Process, WorkerError
from benchmarks.peers_scripts.rows import WORKERS, Row, Variant
from matd3_jax.cli import command
from matd3_jax.cli.options import Command, option
from matd3_jax.runtime import devices
from matd3_jax.runtime.terminal import say


@dataclasses.dataclass(frozen=True)
class Options(Reported):
    """Options of this benchmark."""

    prepare: bool = option("true: only make the environments of the peers that need their own, once", default=False)
    turns: int = option("in each of which every way to do the work is measured", default=3, least=1)
    seconds: float = option("for each measurement", default=2.0, unit="seconds", above=0)
    only: tuple[str, ...] = option(
        "which peers to measure",
        default=tuple(rows.groups(1)),
        choices=tuple(rows.groups(1)),
        metavar="[NAME,NAME,...]",
    )
    envs: Path | None = option(
        "where the peers' virtual environments are", default=None, otherwise="matd3_jax/peers in the cache folder"
    )

    @property
    def folder(self) -> Path:
        """Of the virtual environments."""
        home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
        return home / "matd3_jax" / "peers" if self.envs is None else self.envs.absolute()


COMMAND = Command("python -m benchmarks.peers", Options, __doc__, examples=("python -m benchmarks.peers prepare=true",))

Outcome = list[float] | str
"""Env steps/s of a variant, one for each turn, or the line that says why there are none."""


def main(argv: Sequence[str]) -> int:
    options = COMMAND.parse(argv)
    folder = options.folder
    if options.prepare:
        return prepare(folder, options.only)
    devices.prepare()
    cores = devices.cores()
    report: dict[str, Any] = {
        "machine": devices.description(),
        "versions": devices.versions(),
        "commit": commit(),
        "settings": [word for word in argv if not word.startswith("envs=")],  # where, not what
        "gflops_before": throughput.matmul_gflops(),
    }
    for key in ("machine", "versions", "commit", "gflops_before"):
        say(f"{key}: {report[key]}")
    lines: list[list[str]] = []
    entries: list[dict[str, Any]] = []
    all_versions: dict[str, dict[str, str | None]] = {}
    for name, group in rows.groups(cores).items():
        if name in options.only:
            outcomes, versions = measure(group, options.turns, options.seconds, folder)
            all_versions |= versions
            entries += [entry(row, outcomes) for row in group]
            lines += [line(row, outcomes, versions) for row in group]
    report |= {"peers": all_versions, "rows": entries, "gflops_after": throughput.matmul_gflops()}
    say(f"gflops_after: {report['gflops_after']}\n")
    say(table(lines))
    options.write(report)
    return 0


def prepare(folder: Path, only: Sequence[str]) -> int:
    """Make the environments; 1 if one of them fails."""
    failed = False
    for name, worker in WORKERS.items():
        if worker.requirements and name.lower() in only:
            say(f"{name}: {'; '.join(' '.join(part) for part in worker.requirements)}")
            error = process.install(worker, folder)
            say(f"{name}: {error or 'installed'}")
            failed |= error is not None
    return int(failed)


# ---- measuring -------------------------------------------------------------------------------------------------------


def measure(
    group: Sequence[Row], turns: int, seconds: float, folder: Path
) -> tuple[dict[str, Outcome], dict[str, dict[str, str | None]]]:
    """Env steps/s of every variant of a group of rows, keyed by `key`, and the versions that each worker reports."""
    variants = {key(v): v for row in group for v in (*row.ours, *row.peer)}
    outcomes: dict[str, Outcome] = {k: [] for k in variants}
    versions: dict[str, dict[str, str | None]] = {}
    pools: dict[str, list[Process]] = {}
    with tempfile.TemporaryDirectory() as logs:
        try:
            for k, variant in variants.items():
                try:
                    pool = _pool(variant, pools, folder, Path(logs))
                    if variant.worker not in versions:
                        versions[variant.worker] = _ask(pool[:1], do="versions")[0]
                    took = _ask(pool, do="prepare", case=variant.case)[0]["seconds"]
                    say(f"{variant.worker}, {variant.label}: ready in {took:.0f} s")
                except WorkerError as error:
                    outcomes[k] = str(error)
                    say(f"{variant.worker}, {variant.label}: {error}")
            for turn in range(turns):
                for k, variant in list(variants.items())[:: -1 if turn % 2 else 1]:
                    outcome = outcomes[k]
                    if isinstance(outcome, str):
                        continue
                    try:
                        pool = pools[variant.worker][: variant.processes]
                        answers = _ask(pool, do="measure", case=variant.case, seconds=seconds)
                        outcome.append(sum(a["env_steps"] / a["seconds"] for a in answers))
                        say(f"turn {turn + 1}: {variant.worker}, {variant.label}: {outcome[-1]:,.0f}")
                    except WorkerError as error:
                        outcomes[k] = str(error)
                        say(f"turn {turn + 1}: {variant.worker}, {variant.label}: {error}")
        finally:
            for pool in pools.values():
                for member in pool:
                    member.close()
    return outcomes, versions


def _pool(variant: Variant, pools: dict[str, list[Process]], folder: Path, logs: Path) -> list[Process]:
    """As many processes of the variant's worker as it takes; started where they are missing."""
    worker = WORKERS[variant.worker]
    pool = pools.setdefault(variant.worker, [])
    while len(pool) < variant.processes:
        python = process.python_of(variant.worker, worker, folder)
        pool.append(Process(python, worker, folder / "jax_cache", logs / f"{variant.worker} {len(pool)}"))
    return pool[: variant.processes]


def _ask(pool: Sequence[Process], **request: Any) -> list[dict[str, Any]]:
    """The same question to all at once."""
    for member in pool:
        member.send(**request)
    return [member.receive() for member in pool]


# ---- the table -------------------------------------------------------------------------------------------------------


def key(variant: Variant) -> str:
    """What distinguishes variants; rows may share them."""
    return json.dumps([variant.worker, variant.case, variant.processes], sort_keys=True)


def best(side: Sequence[Variant], outcomes: dict[str, Outcome]) -> tuple[Variant, Outcome]:
    """The variant with the highest median, or the first with its error where none was measured."""
    measured = [(v, o) for v in side if not isinstance(o := outcomes[key(v)], str)]
    if not measured:
        return side[0], outcomes[key(side[0])]
    return max(measured, key=lambda pair: float(np.median(pair[1])))


def entry(row: Row, outcomes: dict[str, Outcome]) -> dict[str, Any]:
    """A row for the JSON, with every variant."""
    found: dict[str, Any] = {"work": row.work}
    for name, side in (("ours", row.ours), ("peer", row.peer)):
        found[name] = [
            {
                "worker": v.worker,
                "label": v.label,
                "processes": v.processes,
                "case": v.case,
                ("error" if isinstance(outcomes[key(v)], str) else "env_steps_per_second"): outcomes[key(v)],
            }
            for v in side
        ]
    ours, peer = best(row.ours, outcomes)[1], best(row.peer, outcomes)[1]
    found["ratio"] = None if isinstance(ours, str) or isinstance(peer, str) else spread(np.divide(ours, peer))
    return found


def line(row: Row, outcomes: dict[str, Outcome], versions: dict[str, dict[str, str | None]]) -> list[str]:
    """A row's cells: work, peer, env steps/s of ours and the peer's, ratio."""
    (mine, ours), (other, peer) = best(row.ours, outcomes), best(row.peer, outcomes)
    failed = isinstance(ours, str) or isinstance(peer, str)
    ratio = "" if failed else _range(spread(np.divide(ours, peer)), digits=True)
    version = versions.get(other.worker, {}).get(WORKERS[other.worker].package) or ""
    name = f"{other.worker} {version}".strip()
    return [row.work, name, f"{_rates(ours)}; {mine.label}", f"{_rates(peer)}; {other.label}", ratio]


def table(lines: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    head = ["work", "peer", "ours, env steps/s", "peer, env steps/s", "ours / peer"]
    cells = [[cell.replace("|", "\\|") for cell in cells] for cells in (head, ["---"] * len(head), *lines)]
    return "\n".join("| " + " | ".join(row) + " |" for row in cells)


def spread(values: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Median, lowest and highest."""
    return {"median": float(np.median(values)), "lowest": float(np.min(values)), "highest": float(np.max(values))}


def _rates(outcome: Outcome) -> str:
    return f"failed: {outcome}" if isinstance(outcome, str) else _range(spread(outcome))


def _range(found: dict[str, float], digits: bool = False) -> str:
    """`digits`: three significant ones for small numbers."""
    texts = [f"{v:,.{max(0, 2 - int(np.floor(np.log10(v)))) if digits else 0}f}" for v in found.values()]
    return f"**{texts[0]}** ({texts[1]} to {texts[2]})"


if __name__ == "__main__":
    sys.argv[0] = "peers"
    command.run(main, COMMAND)
