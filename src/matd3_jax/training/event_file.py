"""TensorBoard's event files, written at once and by records that are whole.

tensorboardX's SummaryWriter writes in a thread of its own, behind a queue of ten events: an error of the disk ends the
thread, and whoever comes next waits for room in the queue for ever.
"""

import os
import socket
import struct
import time
from collections.abc import Mapping
from pathlib import Path

from matd3_jax.runtime import files


class EventFile:
    """What a process writes into one `tensorboard` folder."""

    def __init__(self, folder: Path):
        self.path = folder / f"events.out.tfevents.{int(time.time())}.{socket.gethostname()}.{os.getpid()}"

    def write(self, scalars: Mapping[str, float], step: int) -> None:
        """Append numbers at an env step, by tag, or nothing where that fails. Raises OSError."""
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.summary import scalar

        now = time.time()
        events = [Event(wall_time=now, step=step, summary=scalar(tag, value)) for tag, value in scalars.items()]
        if not (self.path.exists() and self.path.stat().st_size):
            events.insert(0, Event(wall_time=now, file_version="brain.Event:2"))
        self.path.parent.mkdir(parents=True, exist_ok=True)
        files.append(self.path, b"".join(_record(event.SerializeToString()) for event in events))


def _record(data: bytes) -> bytes:
    """A TFRecord: length and data, each with its checksum."""
    from tensorboardX.record_writer import masked_crc32c

    length = struct.pack("<Q", len(data))
    checksums = (struct.pack("<I", masked_crc32c(part)) for part in (length, data))
    return length + next(checksums) + data + next(checksums)
