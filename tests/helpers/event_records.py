"""TensorBoard's event files, read without the library that writes them but for its messages."""

import struct

from tensorboardX.proto.event_pb2 import Event


def crc32c(data):
    """Castagnoli's checksum, bit by bit."""
    found = 0xFFFFFFFF
    for byte in data:
        found ^= byte
        for _ in range(8):
            found = found >> 1 ^ (0x82F63B78 if found & 1 else 0)
    return found ^ 0xFFFFFFFF


def masked(data):
    """As TensorFlow keeps it."""
    found = crc32c(data)
    return ((found >> 15 | found << 17) + 0xA282EAD8) & 0xFFFFFFFF


def events(path):
    """All events of a file, whose checksums are right to its last byte."""
    data, found = path.read_bytes(), []
    while data:
        (length,), (check,) = struct.unpack("<Q", data[:8]), struct.unpack("<I", data[8:12])
        body, (more,) = data[12 : 12 + length], struct.unpack("<I", data[12 + length : 16 + length])
        assert check == masked(data[:8]) and more == masked(body) and len(body) == length
        found.append(Event.FromString(body))
        data = data[16 + length :]
    return found


def scalars(path):
    """(env step, tag, value) of every event, but for the version that begins the file."""
    version, *found = events(path)
    assert version.file_version == "brain.Event:2" and all(len(event.summary.value) == 1 for event in found)
    return [(event.step, event.summary.value[0].tag, event.summary.value[0].simple_value) for event in found]
