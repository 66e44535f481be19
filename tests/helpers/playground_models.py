"""Stand-ins for the meshes that MuJoCo Playground downloads: its own model files need them to be there, and its robots
with feet as their only contacts have the same physics whatever they look like."""

import re
import struct
from pathlib import Path

import numpy as np

CORNERS = np.array([[0, 0, 0], [0.02, 0, 0], [0, 0.02, 0], [0, 0, 0.02]], np.float32)
FACES = ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))


def tetrahedron() -> bytes:
    """A small one, as binary STL."""
    triangles = b"".join(
        struct.pack("<3f", 0, 0, 0) + b"".join(struct.pack("<3f", *CORNERS[i]) for i in face) + b"\0\0"
        for face in FACES
    )
    return b"\0" * 80 + struct.pack("<I", len(FACES)) + triangles


def write(xmls: Path, assets: Path) -> None:
    """A mesh for each that the model files in `xmls` name."""
    assets.mkdir(parents=True)
    for path in xmls.glob("*.xml"):
        for name in re.findall(r'file="([^"]+\.stl)"', path.read_text(), re.IGNORECASE):
            (assets / Path(name).name).write_bytes(tetrahedron())
