"""A worker in Blender's place, and Blender itself where it is installed."""

from __future__ import annotations

import json
import stat
import struct
import sys
from pathlib import Path

import pytest

from blinkgl.blender import process


def triangle() -> bytes:
    """A GLB."""
    binary = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "A", "mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(binary)}],
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


@pytest.fixture
def fake(tmp_path, monkeypatch):
    """``fake(code)``: an interpreter that has bpy, and runs ``code`` instead of the program it is given. The code knows
    ``folder``, ``job``, ``say`` and ``glb`` (the bytes of a triangle)."""

    def make(code: str) -> Path:
        path = tmp_path / "fake" / "python"
        path.parent.mkdir(exist_ok=True)
        head = f"""#!{sys.executable}
import json, os, signal, sys, time
from pathlib import Path
if sys.argv[1] == "-c": sys.exit(0)
folder = Path(sys.argv[2])
job = json.loads((folder / "job.json").read_text())
glb = {triangle()!r}
Path({str(tmp_path / "who")!r}).write_text(f"{{os.getpid()}} {{folder}}")
def say(**words): print(json.dumps(words), flush=True)
REPORT = dict(blender="4.5.15", counts=dict(meshes=1, lights=0), left_out=["no [hair]: 'B'"],
     cameras=["Eye"], camera="Eye", size=[1920, 1080], frames=[1, 49], fps=24.0, keys_per_frame=1, duration_s=2.0,
     baked=["A"], baked_mb=0.25, unbaked=dict(A="its faces change"))
"""
        path.write_text(head + code)
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv(process.ENVIRONMENT, str(path))
        return path

    return make


@pytest.fixture
def blend(tmp_path):
    """A file that a fake takes for a scene."""
    path = tmp_path / "a scene.blend"
    path.write_bytes(b"BLENDER-v405")
    return path
