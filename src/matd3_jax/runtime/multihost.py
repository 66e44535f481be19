"""Several processes, on one host or several, that train one run: who they are, whose seeds are whose, and their
messages.

Seeds are independent, so each process trains its own with the ordinary program on its own devices. Every interval the
others send the first their rows of the metrics table, and all agree whether to stop: nothing else is communicated.
"""

import atexit
import json
import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import jax
import numpy as np

from matd3_jax.errors import UserError, one_line
from matd3_jax.private import coordination_service
from matd3_jax.runtime import devices, slurm
from matd3_jax.runtime.terminal import say


class Share(NamedTuple):
    """Which of a run's seeds are this process's: those from number `first` to before `last`."""

    processes: "Processes"
    first: int
    last: int
    total: int

    @property
    def seeds(self) -> slice:
        return slice(self.first, self.last)


class Processes:
    """The processes that train together. All call the same methods in the same order.

    They talk through the key-value store of JAX's coordination service, not through collectives: those want equally
    many devices in every process, round float64 to float32, and would have the devices wait.

    As a context: what ends one process ends the others, and none leaves before all are done.

    Args:
        index: which of them this is, from 0.
        client: of the coordination service.
        local: how many of them run on this machine.
        name: before the keys of their messages.
    """

    def __init__(self, index: int = 0, size: int = 1, client: Any = None, local: int = 1, name: str = "matd3_jax"):
        self.index, self.size, self.local = index, size, local
        self.first = index == 0
        """The first process alone writes files (but for its part of checkpoints) and prints."""
        self._client, self._name = client, name
        self._calls = 0
        self._sent: list[str] = []

    def share(self, seeds: int) -> Share:
        """This process's part of `seeds`: neighbors, shares differ by one at most. Raises UserError where some process
        would have none."""
        if seeds < self.size:
            raise UserError(
                f"{seeds} {'seed' if seeds == 1 else 'seeds'} for {self.size} processes: each needs at least one; "
                f"raise seeds=, or start {seeds}"
            )
        each, more = divmod(seeds, self.size)
        first = self.index * each + min(self.index, more)
        return Share(self, first, first + each + (self.index < more), seeds)

    def part(self, size: int) -> "Processes | None":
        """The first `size` of them, as processes that work without the others; None in the others."""
        self._calls += 1
        if self.index >= size:
            return None
        return Processes(self.index, min(size, self.size), self._client, self.local, self._key("part"))

    # ---- messages ----------------------------------------------------------------------------------------------------

    def gather_messages(self, message: bytes) -> list[bytes]:
        """All messages, in the order of the processes, to the first of them; nothing to the others."""
        self._calls += 1
        if not self.first:
            self._client.key_value_set_bytes(self._key(self.index), message)
            return []
        found = [message]
        for index in range(1, self.size):
            key = self._key(index)
            found.append(self._receive(key))
            self._client.key_value_delete(key)
        # Whoever has sent this message has received everything broadcast before it.
        for key in self._sent:
            self._client.key_value_delete(key)
        self._sent.clear()
        return found

    def broadcast(self, value: Any = None) -> Any:
        """Send what the first process gives (plain values, as JSON has them) to all."""
        self._calls += 1
        if self.size == 1:
            return value
        key = self._key("broadcast")
        if not self.first:
            return json.loads(self._receive(key))
        self._client.key_value_set_bytes(key, json.dumps(value).encode())
        self._sent.append(key)
        return value

    def barrier(self) -> None:
        """Wait until all processes call this."""
        self.gather_messages(b"barrier")
        self.broadcast()

    def agree(self, number: int) -> int:
        """The largest of what the processes give, to all."""
        return self.broadcast(max((int(m) for m in self.gather_messages(str(number).encode())), default=None))

    def gather(self, row: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Columns [seeds of the process] of numbers, the same ones in all, as columns [seeds of all] in the first
        process; the others keep their own."""
        if self.size == 1:
            return row
        parts = self.gather_messages(np.stack([column.astype(np.float64) for column in row.values()]).tobytes())
        if not parts:
            return row
        whole = np.concatenate([np.frombuffer(part).reshape(len(row), -1) for part in parts], axis=1)
        return {name: values.astype(column.dtype) for (name, column), values in zip(row.items(), whole, strict=True)}

    def check_same(self, text: str, what: str) -> None:
        """Raise UserError unless all give the same text. what: names it in the message."""
        texts = self.gather_messages(text.encode(errors="surrogateescape"))
        for index, other in enumerate(texts):
            if other != texts[0]:
                raise UserError(f"process {index} was given {what} other than process 0: {other.decode()}")
        self.broadcast()

    def _receive(self, key: str) -> bytes:
        """The value of a key as soon as it is there. Raises Left where another process has ended."""
        while True:
            try:
                return self._client.blocking_key_value_get_bytes(key, 1000)
            except jax.errors.JaxRuntimeError as error:
                if "DEADLINE_EXCEEDED" not in str(error):
                    raise Left(f"process 0 cannot be reached any more ({str(error).splitlines()[0]})") from error
            for who, why in self._client.key_value_dir_get(LEFT):
                raise Left(f"process {who.rsplit('/')[-1]} has ended: {why}")

    def description(self) -> dict[str, Any]:
        """The machine and devices; of several processes in the first, which has those of each under "processes"."""
        mine = devices.description()
        each = [json.loads(text) for text in self.gather_messages(json.dumps(mine).encode())]
        return {**mine, "processes": each} if len(each) > 1 else mine

    def same_directory(self, path: Path) -> Path:
        """The directory that the first process has made, in all. Raises UserError where another does not see it."""
        if self.size == 1:
            return path
        found, deadline = Path(self.broadcast(str(path.resolve()))), time.monotonic() + 30
        while not found.is_dir():
            if time.monotonic() > deadline:  # a network file system may take a while to show it
                raise UserError(
                    f"process {self.index} on {socket.gethostname()} does not see {found}: all processes need a file "
                    "system that they share for it"
                )
            time.sleep(0.5)
        return path if self.first else found

    def _key(self, who: Any) -> str:
        return f"{self._name}/{self._calls}/{who}"

    # ---- ending together ---------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.size == 1:
            return
        if error is None:
            self.barrier()
        elif not isinstance(error, Left):
            text = one_line(error) if isinstance(error, UserError) else repr(error)
            self._client.key_value_set(f"{LEFT}/{self.index}", text)


SINGLE_PROCESS = Processes()
"""One process, which does everything by itself."""


END_SECONDS = 60
"""How long a process that ends before its time waits for the others to notice, before they are made to."""

LEFT = "matd3_jax_left"
"""Where processes that end before their time say why."""


class Left(UserError):
    """Another process has ended before its time."""


def start(given: Mapping[str, str]) -> Processes:
    """Meet the other processes, if there are any: given the values of `slurm.KEYS`, or on SLURM.

    To be called after `devices.prepare` and before JAX computes anything. Raises UserError where the settings are
    wrong, or process 0 is not there.
    """
    found = slurm.detect(given, os.environ)
    if found is None or found.num_processes == 1:
        return SINGLE_PROCESS
    address, size, index, _ = found
    # It would catch SIGTERM, which the commands do themselves.
    jax.config.update("jax_enable_preemption_service", False)
    say(f"process {index}: waiting for all {size} processes at {address}")
    slurm.look_for(address, index == 0)
    # What `jax.distributed.initialize` does, but for informing JAX's backends, which would join all processes' devices:
    # Orbax would then write arrays in process 0 only, and the compilation cache be written by that one alone.
    service = coordination_service()()
    service.initialize(
        *found, cluster_detection_method="deactivate", initialization_timeout=slurm.START_SECONDS,
        shutdown_timeout_seconds=END_SECONDS,
    )  # fmt: skip
    atexit.register(service.shutdown)
    processes = Processes(index, size, service.client)
    names = processes.broadcast([name.decode() for name in processes.gather_messages(socket.gethostname().encode())])
    processes.local = names.count(names[index])
    return processes
