"""Files that name other files: whatever library reads a stranger's file, it opens that file and no other.

A bait is a FIFO, whose reader would wait, or a file or program whose use would show."""

from __future__ import annotations

import io
import json
import os
import struct
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import tifffile
import trimesh

from blinkgl.errors import BlinkGLError
from blinkgl.io.formats import open_events
from blinkgl.io.frames import open_frames
from blinkgl.io.reading import Declared
from blinkgl.io.stills import open_stills
from blinkgl.scene.importing.mesh_files import load_asset

SECRET = 231


class Baits:
    """FIFOs that nobody may open for reading: each has a writer that waits for that."""

    def __init__(self, folder: Path):
        self.folder, self.taken, self._made = folder, [], []

    def __call__(self, name: str) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        os.mkfifo(path)
        self._made.append(path)
        threading.Thread(target=self._wait, args=(path,), daemon=True).start()
        return path

    def _wait(self, path: Path) -> None:
        with open(path, "wb"):  # returns when somebody opens it for reading
            self.taken.append(path.name)

    def release(self) -> list[str]:
        taken = list(self.taken)
        for path in self._made:
            os.close(os.open(path, os.O_RDONLY | os.O_NONBLOCK))
        return taken


@pytest.fixture
def baits(tmp_path):
    made = Baits(tmp_path / "private")
    yield made
    assert made.release() == []


def frames(path: Path) -> list[np.ndarray]:
    return [image for image, *_ in open_frames(path, Declared(fps=10.0))]


def ome(names: list[str]) -> str:
    """OME-XML whose pictures are pages of other files."""
    data = "".join(
        f'<TiffData FirstT="{k}" FirstZ="0" FirstC="0" IFD="0" PlaneCount="1"><UUID FileName="{name}">'
        f"urn:uuid:00000000-0000-0000-0000-00000000000{k + 2}</UUID></TiffData>"
        for k, name in enumerate(names)
    )
    pixels = 'ID="Pixels:0" DimensionOrder="XYZTC" Type="uint8" SizeX="32" SizeY="24" SizeZ="1" SizeC="1"'
    return (
        '<?xml version="1.0" encoding="UTF-8"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" '
        'UUID="urn:uuid:00000000-0000-0000-0000-000000000001"><Image ID="Image:0">'
        f'<Pixels {pixels} SizeT="{len(names)}">{data}</Pixels></Image></OME>'
    )


@pytest.mark.parametrize("ending", ["clip.tif", "clip.ome.tif"])
@pytest.mark.parametrize("absolute", [False, True])
def test_ome_descriptions_lead_nowhere(tmp_path, monkeypatch, ending, absolute):
    (private := tmp_path / "private").mkdir()
    (download := tmp_path / "download").mkdir()
    for k in range(3):
        tifffile.imwrite(private / f"{k}.tif", np.full((24, 32), SECRET, np.uint8))
    text = ome([f"{private if absolute else '../private'}/{k}.tif" for k in range(3)])
    tifffile.imwrite(download / ending, np.zeros((24, 32), np.uint8), description=text, metadata=None)
    # Named relative to the folder that one stands in, too.
    monkeypatch.chdir(download)
    try:
        assert not any((image == SECRET).any() for image in frames(download / ending))
    except BlinkGLError as error:
        assert "two frames" in str(error)


@pytest.mark.parametrize("name", ["NDTiff.index", "clip_MMStack_Pos0_1.ome.tif"])
def test_no_file_beside_a_tiff_is_opened(tmp_path, baits, monkeypatch, name):
    """NDTiff's index and MicroManager's further files lie beside a file, or in the folder that one stands in: tifffile
    is told that it is of both kinds, and asks for none."""
    folder = baits(name).parent
    monkeypatch.chdir(folder)
    path = folder / "clip_MMStack_Pos0.ome.tif"
    tifffile.imwrite(path, np.zeros((2, 24, 32), np.uint8), metadata=None)
    summary = {"Summary": {"Prefix": "clip", "MajorVersion": 3}, "MajorVersion": 3, "IndexMap": np.zeros((2, 5), int)}
    monkeypatch.setattr(tifffile.TiffFile, "micromanager_metadata", summary)
    try:
        frames(path)
    except BlinkGLError as error:
        assert "\n" not in str(error)


def test_no_program_is_run_for_a_picture(tmp_path):
    """PostScript under another name: Pillow would run gs."""
    (programs := tmp_path / "bin").mkdir()
    (programs / "gs").write_text(f"#!/bin/sh\ntouch {tmp_path}/RAN\n")
    (programs / "gs").chmod(0o755)
    script = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 24\n%%EndComments\nshowpage\n%%EOF\n"
    for ending in ("png", "gif", "jpg", "bmp", "tif", "webp", "tga", "ppm", "avif", "jp2"):
        (tmp_path / f"a.{ending}").write_bytes(script)
    program = (
        "import sys; from pathlib import Path; from blinkgl.errors import BlinkGLError\n"
        "from blinkgl.io.stills import open_stills\n"
        "for path in sorted(Path(sys.argv[1]).glob('a.*')):\n"
        "    try: open_stills(path).read(); print('read', path)\n"
        "    except BlinkGLError as error: pass\n"
    )
    environment = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}
    run = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], env=environment, capture_output=True, text=True, check=True
    )
    assert run.stdout == "" and not (tmp_path / "RAN").exists()


PLAYLISTS = {
    "concat": "ffconcat version 1.0\nfile {bait}\n",
    "hls": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{bait}\n#EXT-X-ENDLIST\n",
    "hls url": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nconcat:{bait}\n#EXT-X-ENDLIST\n",
    "dash": '<?xml version="1.0"?><MPD><Period><AdaptationSet><Representation><BaseURL>{bait}</BaseURL>'
    "</Representation></AdaptationSet></Period></MPD>",
    "sdp": "v=0\nc=IN IP4 127.0.0.1\nm=video 9 RTP/AVP 96\n",
}


@pytest.mark.parametrize("kind", PLAYLISTS)
@pytest.mark.parametrize("ending", ["mp4", "mkv", "avi", "webm", "mov"])
def test_playlists_are_no_videos(tmp_path, baits, kind, ending):
    path = tmp_path / f"clip.{ending}"
    path.write_text(PLAYLISTS[kind].format(bait=baits("secret.ts")))
    with pytest.raises(BlinkGLError, match="cannot read video"):
        frames(path)


@pytest.mark.parametrize(
    "name", ["concat:a.mp4", "http:a.mp4", "data:a.mp4", "pipe:0.mp4", "subfile,,start,0,end,0,,:a.mp4"]
)
def test_a_name_is_no_protocol(tmp_path, monkeypatch, name):
    """A file of that name is read, and what the protocol would open is not."""
    monkeypatch.chdir(tmp_path)
    with av.open("a.mkv", "w") as file:
        stream = file.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 32, 24, "gray"
        for k in range(3):
            frame = av.VideoFrame.from_ndarray(np.full((24, 32), 9 * k, np.uint8), format="gray")
            for packet in [*stream.encode(frame), *(stream.encode() if k == 2 else ())]:
                file.mux(packet)
    Path("a.mkv").rename(name.replace(".mp4", ".mkv"))
    assert len(frames(Path(name.replace(".mp4", ".mkv")))) == 3
    with pytest.raises(BlinkGLError, match="no such file"):
        frames(Path(name))


def test_a_bag_names_files_of_its_folder_only(tmp_path, baits):
    pytest.importorskip("rosbags", reason="optional extra [formats]")
    bait = baits("secret.db3")
    (folder := tmp_path / "bag").mkdir()
    for named in (str(bait), "../private/secret.db3"):
        (folder / "metadata.yaml").write_text(
            "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n"
            f"  relative_file_paths: ['{named}']\n  duration: {{nanoseconds: 1}}\n"
            "  starting_time: {nanoseconds_since_epoch: 0}\n  message_count: 1\n  topics_with_message_count: []\n"
        )
        with pytest.raises(BlinkGLError, match="damaged bag"):
            open_events(folder).read()
    (folder / "metadata.yaml").write_text("a: !!python/object/apply:os.mkfifo ['RAN']\n")
    with pytest.raises(BlinkGLError):
        open_events(folder).read()


def _glb(tree: dict) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sII", b"glTF", 2, 20 + len(text)) + struct.pack("<I4s", len(text), b"JSON") + text


@pytest.mark.parametrize("lead", ["{bait}", "../private/{name}", "file://{bait}"])
@pytest.mark.parametrize("ending", ["obj", "gltf", "glb", "dae", "3mf", "ply", "off"])
def test_meshes_lead_nowhere(tmp_path, baits, ending, lead):
    bait = baits("secret.png")
    to = lead.format(bait=bait, name=bait.name)
    (tmp_path / "set").mkdir()
    path = tmp_path / "set" / f"mesh.{ending}"
    if ending == "obj":
        path.write_text(f"mtllib {to}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    elif ending in ("gltf", "glb"):
        tree = {
            "asset": {"version": "2.0"}, "buffers": [{"uri": to, "byteLength": 36}], "images": [{"uri": to}],
            "bufferViews": [{"buffer": 0, "byteLength": 36}], "textures": [{"source": 0}],
            "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}], "scene": 0,
        }  # fmt: skip
        path.write_bytes(json.dumps(tree).encode() if ending == "gltf" else _glb(tree))
    elif ending == "3mf":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(
                "3D/3dmodel.model", f'<?xml version="1.0"?><!DOCTYPE m [<!ENTITY x SYSTEM "{to}">]><model>&x;</model>'
            )
    elif ending == "dae":
        path.write_text(f'<?xml version="1.0"?><!DOCTYPE C [<!ENTITY x SYSTEM "{to}">]><COLLADA>&x;</COLLADA>')
    else:
        text = trimesh.creation.box().export(file_type=ending)
        text = text.encode() if isinstance(text, str) else text
        path.write_bytes(
            text.replace(b"ply\n", f"ply\ncomment TextureFile {to}\n".encode(), 1) if ending == "ply" else text
        )
    try:
        load_asset(path)
    except BlinkGLError as error:
        assert "\n" not in str(error)


def test_opencv_and_numpy_read_bytes(tmp_path, baits):
    """OpenCV expands patterns of numbered files, and NumPy unpickles, where they are given a path and may."""
    baits("frame_00.png")
    folder = tmp_path / "frames"
    folder.mkdir()
    for name in ("frame_%02d.png", "frame_%02d.hdr", "frame_%02d.tif"):
        cv2.imwrite(str(folder / "x.png"), np.zeros((4, 4), np.uint16))
        (folder / "x.png").rename(folder / name)
        try:
            open_stills(folder / name).read()
        except BlinkGLError as error:
            assert "\n" not in str(error)

    class Bomb:
        def __reduce__(self):
            return os.mkfifo, (str(tmp_path / "RAN"),)

    buffer = io.BytesIO()
    np.save(buffer, np.array([Bomb()], object), allow_pickle=True)
    (tmp_path / "e.npy").write_bytes(buffer.getvalue())
    with zipfile.ZipFile(tmp_path / "e.npz", "w") as archive:
        archive.writestr("frames.npy", buffer.getvalue())
        archive.writestr("events.npy", buffer.getvalue())
    for read in (frames, lambda path: open_events(path).read()):
        for name in ("e.npy", "e.npz"):
            with pytest.raises(BlinkGLError):
                read(tmp_path / name)
    assert not (tmp_path / "RAN").exists()


HEADS = {
    "png": b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\1\0\0\0\1\x10\0\0\0\0", "tif": b"II*\0\x08\0\0\0\1\0",
    "apng": b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\0\1", "webp": b"RIFF\x40\0\0\0WEBPVP8X\x0a\0\0\0\2",
    "gif": b"GIF89a\1\0\1\0\0\0\0", "jpg": b"\xff\xd8\xff\xe0\0\x10JFIF", "ppm": b"P6 1 1 255\n",
    "bmp": b"BM" + bytes(9), "hdr": b"#?RADIANCE\n", "exr": struct.pack("<II", 20000630, 2), "pfm": b"PF\n1 1\n-1\n",
    "avif": bytes(30), "jp2": bytes(30), "tga": bytes(9),
}  # fmt: skip


@pytest.mark.parametrize("ending", HEADS)
def test_headers_that_end_anywhere_are_one_line(tmp_path, ending):
    """What the fuzz found in a cut IHDR."""
    for length in range(len(HEADS[ending]) + 1):
        (tmp_path / f"a.{ending}").write_bytes(HEADS[ending][:length])
        with pytest.raises(BlinkGLError) as caught:
            open_stills(tmp_path / f"a.{ending}").read()
        assert "\n" not in str(caught.value)
