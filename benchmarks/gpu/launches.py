"""What the device does between two launches: kernels of an iteration, and the share of the time in which none runs."""

import re
import tempfile
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
from jax.profiler import ProfileData, ProfileOptions

from benchmarks.gpu import seeds, timing
from benchmarks.gpu.report import Report, Row
from benchmarks.gpu.timing import Compiled, Length
from matd3_jax.training.state import TrainState

STREAM = re.compile(r"Stream #")
"""Lines of a device's plane that hold what ran; the others show the same again, by module or by source."""
COPY = re.compile(r"^mem(cpy|set)", re.IGNORECASE)
TOP = 12


def run(report: Report, scale: float, length: Length) -> None:
    counts = (20, 1024) if scale >= 1 else (2,)
    few = length._replace(iterations=min(length.iterations, 5))
    for count in counts:
        capacity = 100_000 if scale >= 1 else 10_000
        line = seeds.settings(count, capacity)
        report.case("launches", f"simple_spread, {count} seeds", lambda line=line: measure(line, few))


def measure(overrides: list[str], length: Length) -> Row:
    """The whole loop, timed without and then traced with the profiler.

    XLA leaves its command buffers (CUDA graphs) out while a profiler runs: what a kernel takes is the same, what lies
    between two of them is not. So "idle" is the share of the time WITHOUT the profiler that the kernels of the trace
    leave, and "idle_traced" that of the traced block.
    """
    at = timing.setting(overrides)
    program = timing.compiled(at, "loop", length.iterations)
    state, row = timing.timed(program, at.state, length)
    seen = trace(program, state)
    if seen is None:
        return {"cycle_seconds": row["cycle_seconds"], "device_stream": "none in the trace: no launches to count"}
    busy = seen.pop("busy_seconds") / program.iterations
    return {
        "cycle_seconds": row["cycle_seconds"],
        "busy_seconds_per_cycle": busy,
        "idle": max(0.0, 1 - busy / row["cycle_seconds"]),
        "kernels_per_cycle": seen.pop("kernels") / program.iterations,
        "copies_per_cycle": seen.pop("copies") / program.iterations,
        **seen,
    }


def trace(program: Compiled, state: TrainState) -> Row | None:
    """One call of the program under the profiler, as `read` sums it up."""
    options = ProfileOptions()
    options.host_tracer_level = options.python_tracer_level = 0  # the device only
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder, profiler_options=options):
            jax.block_until_ready(program(state))
        files = list(Path(folder).glob("**/*.xplane.pb"))
        return read(ProfileData.from_file(str(files[0]))) if files else None


def read(data: ProfileData) -> Row | None:
    """What the streams of all devices did: numbers of kernels and of copies, seconds from the first to the last, in
    which at least one of them ran, and which took longest. None without a device stream: CPUs have none."""
    devices = [
        [event for line in plane.lines if STREAM.match(line.name) for event in line.events]
        for plane in data.planes
        if plane.name.startswith("/device:")
    ]
    devices = [events for events in devices if events]
    if not devices:
        return None
    window = busy = 0.0
    kernels: list[Any] = []
    copies = 0
    for events in devices:
        spans = [(event.start_ns, event.start_ns + event.duration_ns) for event in events]
        window += max(end for _, end in spans) - min(start for start, _ in spans)
        busy += covered(spans)
        ours = [event for event in events if not COPY.match(event.name)]
        kernels += ours
        copies += len(events) - len(ours)
    times: Counter[str] = Counter()
    for event in kernels:
        # fusion_12 and fusion_7 are two places of the program, so each by its own name.
        times[event.name[:80]] += event.duration_ns
    return {
        "kernels": len(kernels),
        "copies": copies,
        "window_seconds": window / 1e9,
        "busy_seconds": busy / 1e9,
        "idle_traced": 1 - busy / window if window else 0.0,
        "longest": [{"kernel": name, "share": round(time / busy, 4)} for name, time in times.most_common(TOP)],
    }


def covered(spans: Iterable[tuple[float, float]]) -> float:
    """Length of the union of intervals (start, end): streams may run at the same time."""
    total, until = 0.0, float("-inf")
    for start, end in sorted(spans):
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total
