"""Where the processes of a run meet: from three settings on the command line, or from SLURM's environment."""

import errno
import re
import socket
import time
from collections.abc import Mapping
from typing import NamedTuple

from matd3_jax.errors import UserError

KEYS = ("coordinator_address", "num_processes", "process_id")
"""Settings of a command that several processes share, as `jax.distributed.initialize` calls them."""

START_SECONDS = 300
"""How long processes wait for each other at the start."""


class Cluster(NamedTuple):
    """What `jax.distributed.initialize` needs to know."""

    coordinator_address: str
    num_processes: int
    process_id: int
    local_device_ids: tuple[int, ...] | None = None
    """Numbers of the visible GPUs that are this process's; None: all of them."""


def detect(given: Mapping[str, str], environ: Mapping[str, str]) -> Cluster | None:
    """The cluster that the settings name, or SLURM's environment where a job step (`srun`) has several tasks; None for
    a single process. Raises UserError for settings that are incomplete or impossible."""
    if given:
        return _settings(given)
    # Of the step, not of the job: what a batch script starts without srun is alone, whatever the job's SLURM_NTASKS.
    if int(environ.get("SLURM_STEP_NUM_TASKS", 1)) < 2 or "SLURM_STEP_NODELIST" not in environ:
        return None
    node = re.match(r"([^,\[]+)(?:\[([^-,\]]+))?", environ["SLURM_STEP_NODELIST"])
    assert node is not None
    # The same in all tasks; other jobs and steps should get others.
    port = 61440 + (int(environ["SLURM_JOB_ID"]) + 97 * int(environ.get("SLURM_STEP_ID", 0))) % 4096
    address = f"{node[1]}{node[2] or ''}:{environ.get('JAX_COORDINATOR_PORT', port)}"
    return Cluster(address, int(environ["SLURM_STEP_NUM_TASKS"]), int(environ["SLURM_PROCID"]), _gpus(environ))


def _settings(given: Mapping[str, str]) -> Cluster:
    for key in KEYS:
        if key not in given:
            there = " ".join(f"{name}={given[name]}" for name in KEYS if name in given)
            raise UserError(f"{there}: {key}= is missing; several processes need all of {', '.join(KEYS)}")
    address = given["coordinator_address"]
    if not re.fullmatch(r"(\[[^\]]+\]|[^:\s]+):\d{1,5}", address) or not 0 < int(address.rsplit(":")[-1]) < 65536:
        raise UserError(f"coordinator_address={address}: must be HOST:PORT, for instance 127.0.0.1:1234")
    for key, least in (("num_processes", 1), ("process_id", 0)):
        if not re.fullmatch(r"\d+", given[key]) or int(given[key]) < least:
            raise UserError(f"{key}={given[key]}: must be a whole number of at least {least}")
    size, index = int(given["num_processes"]), int(given["process_id"])
    if index >= size:
        raise UserError(f"process_id={index}: with num_processes={size} it goes from 0 to {size - 1}")
    return Cluster(address, size, index)


def _gpus(environ: Mapping[str, str]) -> tuple[int, ...] | None:
    """This task's part of the GPUs that it sees; None: all, as it is alone on its node or each task sees its own."""
    counts = []
    for count, times in re.findall(r"(\d+)(?:\(x(\d+)\))?", environ.get("SLURM_STEP_TASKS_PER_NODE", "")):
        counts += [int(count)] * int(times or 1)
    node, task = int(environ.get("SLURM_NODEID", 0)), int(environ.get("SLURM_LOCALID", 0))
    tasks = counts[node] if node < len(counts) else 1
    visible = [gpu for gpu in environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if gpu]
    if tasks == 1 or len(visible) < tasks or "SLURM_GPUS_PER_TASK" in environ:
        return None
    return tuple(range(len(visible))[task::tasks])


def look_for(address: str, first: bool) -> None:
    """Raise UserError where process 0 cannot open its port, or the others do not find it: where JAX would abort."""
    host, port = address.rsplit(":", 1)
    try:
        socket.getaddrinfo(host.strip("[]"), int(port))
    except OSError as error:
        raise UserError(f"coordinator_address={address}: there is no host {host} ({error.strerror})") from error
    if first:
        for family in (socket.AF_INET6, socket.AF_INET):
            try:
                with socket.socket(family) as probe:
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    probe.bind(("", int(port)))
            except OSError as error:
                if error.errno in (errno.EADDRINUSE, errno.EACCES):  # others: a machine without IPv6, say
                    why = f"cannot open port {port} ({error.strerror})"
                    raise UserError(f"coordinator_address={address}: {why}") from None
        return
    deadline = time.monotonic() + START_SECONDS
    while True:
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()
            return
        except OSError as error:
            if time.monotonic() > deadline:
                raise UserError(
                    f"coordinator_address={address}: process 0 was not there within {START_SECONDS} s ({error})"
                ) from error
            time.sleep(0.2)
