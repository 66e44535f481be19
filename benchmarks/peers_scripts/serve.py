"""The measuring end of `benchmarks.peers`: needs nothing but Python, so that it runs in every peer's environment.

A script calls `serve(prepare, packages)` with a function that takes a case (a dictionary) and returns a block: a
function that plays some env steps and returns how many. Requests come one a line on the standard input, answers go one
a line to what was the standard output; all other output goes to the standard error.
"""

import importlib.metadata
import json
import os
import platform
import sys
import time
import traceback
from collections.abc import Callable, Sequence

Block = Callable[[], int]


def serve(prepare: Callable[[dict], Block], packages: Sequence[str]) -> None:
    """Answer requests until the input ends. The script's argument: how many cores it may use, 0 for all.

    {"do": "versions"}: {"python": ..., package: version or null}.
    {"do": "prepare", "case": {...}}: {"seconds": of preparing, one block included}.
    {"do": "measure", "case": {...}, "seconds": s}: {"env_steps": n, "seconds": t} of whole blocks, for s or more.
    Whatever is raised is answered with {"error": its last line}.
    """
    cores = int(sys.argv[1])
    if cores and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-cores:])
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)
        blocks: dict[str, Block] = {}
        for line in sys.stdin:
            request = json.loads(line)
            try:
                answer = _answer(request, prepare, packages, blocks)
            except Exception:
                traceback.print_exc()
                answer = {"error": traceback.format_exc().strip().splitlines()[-1]}
            answers.write(json.dumps(answer) + "\n")
            answers.flush()


def _answer(request: dict, prepare: Callable, packages: Sequence[str], blocks: dict[str, Block]) -> dict:
    if request["do"] == "versions":
        return {"python": platform.python_version()} | {name: _version(name) for name in packages}
    key = json.dumps(request["case"], sort_keys=True)
    begun = time.perf_counter()
    if request["do"] == "prepare":
        blocks[key] = prepare(request["case"])
        blocks[key]()
        return {"seconds": time.perf_counter() - begun}
    env_steps, seconds = 0, 0.0
    while seconds < request["seconds"]:
        env_steps += blocks[key]()
        seconds = time.perf_counter() - begun
    return {"env_steps": env_steps, "seconds": seconds}


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
