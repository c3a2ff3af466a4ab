"""Damaged files: each mutant of a small whole file, or of a data set with one file damaged, is read, or refused with
one line.

    python -m blinkgl.tools.fuzz [NAME … | configurations] [--mutants 200] [--seed 0] [--only K] [--keep FILE]

A mutant is read in a process of its own, under a clock and a memory limit. Defects are a traceback, a crash, a message
of several lines, more than ``CPU_S`` processor seconds or ``MEMORY_MB`` more memory. Each is printed with the command
that repeats it; FILE keeps the last. The same seed and version make the same mutants. The exit status is 1 when there
are defects.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import json
import multiprocessing
import os
import re
import resource
import shlex
import shutil
import signal
import struct
import sys
import tempfile
import traceback
import zlib
from collections import Counter
from collections.abc import Callable
from functools import partial
from importlib import resources
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import hdf5plugin
import numpy as np
import trimesh

from blinkgl.config.camchain import read_camchain
from blinkgl.config.camera import CameraConfig
from blinkgl.config.run import load_run
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.shards import export_shards
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import BlinkGLError
from blinkgl.io.flow import read_flo, read_flow, read_flow_png, write_flow
from blinkgl.io.formats import open_events, write_events
from blinkgl.io.frames import open_frames, read_any_image
from blinkgl.io.reading import Declared, EventReading
from blinkgl.io.records import sealed
from blinkgl.io.times import read_timestamps
from blinkgl.io.trajectories import PoseFile, read_trajectory
from blinkgl.layouts import export_layout
from blinkgl.report.page import write_report
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.mesh_files import load_asset
from blinkgl.scene.reading import reading
from blinkgl.scene.worlds.from_file import from_document
from blinkgl.sequence_files.sequence_dir import digest_of
from blinkgl.tools import fuzz_configurations, fuzz_files
from blinkgl.viewer.views import SequenceView, sequences_in
from eflow.checkpoint import read_tensors
from eflow.data.sources import open_source
from eflow.published import read_published

CPU_S, WALL_S, MEMORY_MB = 10, 60.0, 2048
READ, REFUSED = "read", "refused"
FORK = multiprocessing.get_context("fork")
CONFIG = str(resources.files("blinkgl.configs") / "demo.yaml")


class Format(NamedTuple):
    """make(path) writes a whole file; read(path) reads it as the commands do.   files : those that may be damaged."""

    make: Callable[[Path], object]
    read: Callable[[Path], object]
    files: Callable[[Path], list[Path]] = lambda path: [path]


def _events_as(
    make: fuzz_files.Make = lambda path, events: write_events(path, events, fuzz_files.HEIGHT, fuzz_files.WIDTH),
    **declared: Any,
) -> Format:
    """Events, written by ``make`` (as the ending says), are read; the whole parts of a damaged file, too.   declared :
    what the file does not say, as options of the commands."""

    def read(path: Path) -> None:
        with (
            contextlib.suppress(BlinkGLError),
            open_events(path, EventReading.of(damaged="keep", sort=True, **declared)) as file,
        ):
            list(file.chunks())
        with open_events(path, EventReading.of(**declared)) as file:
            sized = file.sized()
            for events in sized.chunks():
                assert not len(events) or (events.x.max() < sized.width and events.y.max() < sized.height)

    return Format(lambda path: make(path, fuzz_files.events()), read)


def _sound(flow: np.ndarray, valid: np.ndarray) -> None:
    assert np.isfinite(flow[valid]).all(), "a valid flow that is not finite"


def _write_picture(path: Path) -> None:
    for file in (path, path.with_stem("1")):
        if path.suffix == ".pfm":
            cv2.imwrite(str(file), fuzz_files.picture().astype(np.float32) / 255)
        else:
            cv2.imwrite(str(file), fuzz_files.picture())


def _read_frames(path: Path) -> None:
    """A folder of two frames, or an array of frames."""
    list(open_frames(path if path.suffix in (".npy", ".npz") else path.parent, Declared(fps=100.0)))


def _text(text: str, read: Callable[[Path], object]) -> Format:
    return Format(lambda path: path.write_text(text), read)


def _poses(path: Path) -> None:
    """At a rate where the file has no times: nothing is infinite."""
    t_ns, T = read_trajectory(path, PoseFile(rate=10.0))
    assert len(t_ns) == len(T) and np.isfinite(T).all(), "poses that are not finite"


def _camera(path: Path) -> None:
    for one in read_camchain(path).values():
        assert np.isfinite(one.camera.project(np.array([[0.0, 0.0, 1.0]]))).all(), "a camera that sees nothing"


def _scene(path: Path) -> None:
    with reading("scene", str(path)):
        made = from_document(gltf.read(path), CameraConfig(width=64, height=48).model, 0, 10**9, intrinsics="file")
    assert all(np.isfinite(body.path.pose(5 * 10**8)).all() for body in made.objects), "poses that are not finite"


def _below(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file())


def _exported(layout: str) -> Format:
    """An export of a data set: what reads the published data set reads it."""

    def make(path: Path) -> None:
        with tempfile.TemporaryDirectory(prefix="blinkgl-fuzz-") as folder:
            run_dataset(load_run(CONFIG, re.split(r" (?=[a-z]\w*[.=])", SMALL)), Path(folder) / "set")
            export_layout(Path(folder) / "set", path, layout)

    def read(path: Path) -> None:
        refused: list[BlinkGLError] = []
        for file in (*path.rglob("*.h5"), *path.rglob("*.hdf5")):
            with collected(refused), open_events(file) as opened:
                list(opened.sized().chunks())
        with collected(refused):
            _samples(path, path)
        for file in path.rglob("cam_to_cam.yaml"):
            with collected(refused):
                _camera(file)
        # Files of labels hold no events: a refusal counts where it is no single line.
        for error in (error for error in refused if "\n" in str(error)):
            raise error

    return Format(make, read, _below)


SMALL = (
    "camera.width=32 camera.height=24 time.duration=0.1 time.label_rate=20 output.sequences=1 preview.enabled=false "
    "labels={flow: [forward, backward, 0.01], depth: true, boxes: true, ids: true}"
)


def _set_of(layouts: tuple[str, ...], *changes: str) -> Format:
    """A data set of the shipped demo with ``changes``; everything that opens data sets of others reads it."""
    exports = [partial(_laid_out, name=name) for name in layouts]

    def make(path: Path) -> None:
        run_dataset(load_run(CONFIG, re.split(r" (?=[a-z]\w*[.=])", SMALL) + list(changes)), path)

    def files(path: Path) -> list[Path]:
        later = re.compile(r"(?!0+\.)\d+\.")  # of the numbered files of a folder, the first stands for all
        return sorted(file for file in path.rglob("*") if file.is_file() and not later.match(file.name))

    def read(path: Path) -> None:
        with tempfile.TemporaryDirectory(prefix="blinkgl-fuzz-") as folder:
            copy = shutil.copytree(path, Path(folder) / "set")
            _sealed_again(copy)
            refused = []
            for number, reader in enumerate((*_SET_READERS, *exports)):
                with collected(refused):
                    reader(copy, Path(folder) / str(number))
        if refused:
            raise max(refused, key=lambda error: str(error).count("\n"))

    return Format(make, read, files)


@contextlib.contextmanager
def collected(refused: list[BlinkGLError]):
    """Append a refusal instead of raising it."""
    try:
        yield
    except BlinkGLError as error:
        refused.append(error)


def _sealed_again(folder: Path) -> None:
    """Bring manifests in line with their files, from the inside out, so that not only checksums find the damage."""
    for path in sorted(folder.rglob("manifest.json"), key=lambda path: -len(path.parts)):
        with contextlib.suppress(Exception):  # damaged itself
            manifest = json.loads(path.read_text())
            manifest["files"] = {name: digest_of(path.parent / name) for name in manifest["files"]}
            path.write_text(sealed(manifest))


def _views(folder: Path, _: Path) -> None:
    for sequence in sequences_in(folder):
        with contextlib.closing(SequenceView(sequence)) as view:
            view.extent()
            for t_us in (view.start_us, (view.start_us + view.end_us) // 2, view.end_us):
                for sensor in view.sensors:
                    sensor.pictures(t_us, 1000), sensor.bodies(t_us), sensor.depth_cloud(t_us), sensor.camera_pose(t_us)
                    if sensor.event_count:
                        sensor.event_points(t_us, 1000)


def _samples(folder: Path, _: Path) -> None:
    source = open_source(folder)
    for k in range(len(source)):
        source[k]


def _laid_out(folder: Path, out: Path, name: str) -> None:
    export_layout(folder, out, name)


_SET_READERS: tuple[Callable[[Path, Path], object], ...] = (
    export_shards,
    lambda folder, out: verify_dataset(folder),
    lambda folder, out: write_report(folder, out.with_suffix(".html")),
    _views,
    _samples,
)

US = {"time_unit": "us"}
FRAMES = Format(_write_picture, _read_frames)
MESH = Format(lambda path: trimesh.creation.box().export(path), load_asset)
FORMATS = {
    **{name: _events_as() for name in ("e.txt", "e.csv", "e.h5", "e.npz", "e.npy", "e.raw", "e.aedat4")},
    "e.es": _events_as(fuzz_files.es),
    "e.dat": _events_as(fuzz_files.dat),
    "e.bin": _events_as(fuzz_files.five_bytes),
    "e.mat": _events_as(fuzz_files.mat, **US),
    "e73.mat": _events_as(fuzz_files.mat73, **US),
    "e.txt.gz": _events_as(fuzz_files.gz, columns="t,x,y,p", **US),
    "e.bag": _events_as(fuzz_files.bag),
    "rows.hdf5": _events_as(fuzz_files.rows),
    "gzip.h5": _events_as(fuzz_files.h5({"compression": "gzip", "shuffle": True}, {"compression": "lzf"}), **US),
    "zstd.h5": _events_as(
        fuzz_files.h5(dict(hdf5plugin.Zstd()), dict(hdf5plugin.LZ4()), dict(hdf5plugin.Blosc())), **US
    ),
    "flow.png": Format(lambda path: write_flow(path, *fuzz_files.flow()), lambda path: _sound(*read_flow_png(path))),
    "flow.flo": Format(lambda path: write_flow(path, *fuzz_files.flow()), lambda path: _sound(*read_flo(path))),
    **{f"0.{ending}": FRAMES for ending in ("png", "jpg", "tiff", "pfm", "hdr")},
    "frames.npy": Format(lambda path: np.save(path, np.stack([fuzz_files.picture()] * 2)), _read_frames),
    "3.png": Format(fuzz_files.saved, lambda path: list(open_frames(path))),
    **{f"0.{ending}": Format(fuzz_files.saved, read_any_image) for ending in ("webp", "jp2", "tga", "bmp", "avif")},
    "0.exr": Format(fuzz_files.exr, read_any_image),
    "a.gif": Format(fuzz_files.saved, lambda path: list(open_frames(path))),
    "stack.tif": Format(fuzz_files.stack, lambda path: list(open_frames(path))),
    "frames.npz": Format(
        lambda path: np.savez_compressed(path, frames=np.stack([fuzz_files.picture()] * 3), t_us=np.arange(3)),
        lambda path: list(open_frames(path)),
    ),
    **{
        name: Format(fuzz_files.video(*kind), lambda path: list(open_frames(path)))
        for name, kind in (
            ("v.mp4", ("libx264", "yuv420p")),
            ("v.mkv", ("ffv1", "gray")),
            ("v.avi", ("mjpeg", "yuvj420p")),
            ("v.webm", ("libvpx-vp9", "yuv420p")),
            ("v.mov", ("png", "rgb24")),
        )
    },
    "frame set": Format(fuzz_files.frame_set, lambda path: list(open_frames(path / "images")), _below),
    "flow.flo5": Format(fuzz_files.spring, lambda path: _sound(*read_flow(path))),
    "flow.npy": Format(lambda path: write_flow(path, *fuzz_files.flow()), lambda path: _sound(*read_flow(path))),
    "tum.txt": _text(fuzz_files.POSES, _poses),
    "euroc.csv": _text(fuzz_files.EUROC, _poses),
    "kitti.txt": _text("".join(fuzz_files.KITTI.format(k) for k in range(9)), _poses),
    "images.txt": _text(fuzz_files.COLMAP, _poses),
    "transforms.json": _text(json.dumps(fuzz_files.NERF), _poses),
    "stamps.txt": _text(fuzz_files.STAMPS, read_timestamps),
    "camchain.yaml": _text(fuzz_files.KALIBR, _camera),
    "opencv.yaml": _text(fuzz_files.OPENCV, _camera),
    "cameras.txt": _text(
        "1 OPENCV 640 480 500 500 320 240 -0.1 0.01 0 0\n2 PINHOLE 640 480 500 500 320 240\n", _camera
    ),
    "e.db3": Format(
        lambda path: fuzz_files.bag2("SQLITE3")(path, fuzz_files.events()),
        lambda path: open_events(path).read(),
        _below,
    ),
    "e.mcap": Format(
        lambda path: fuzz_files.bag2("MCAP")(path, fuzz_files.events()), lambda path: open_events(path).read(), _below
    ),
    **{f"export {layout}": _exported(layout) for layout in ("dsec", "blinkflow", "mvsec")},
    "scene.glb": Format(fuzz_files.scene, _scene),
    **{f"{name}.pt": Format(fuzz_files.tensors, read_published) for name in ("zip", "old")},
    "weights.safetensors": Format(fuzz_files.tensors, read_tensors),
    **{f"mesh.{ending}": MESH for ending in ("obj", "ply", "stl", "glb")},
    "camera": _set_of(("dsec", "blinkflow", "mvsec", "tapvid"), "tracks={points: 20}"),
    "exposures": _set_of(("dsec", "blinkflow"), "images={exposure_us: 5000}"),
    "rig": _set_of(
        ("dsec", "blinkflow", "mvsec"),
        "sensors=[{name: left, imu: {rate: 200}, events: {}}, {name: right, place: {position: [0.1, 0, 0]}}]",
    ),
    "run.yaml": Format(lambda path: path.write_text(Path(CONFIG).read_text()), lambda path: load_run(path).sequence(0)),
}


NUMBERS = (0, 1, -1, 127, 255, 256, 32768, 65535, 10**6, 2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**63 - 1, 2**64 - 1)
TOKENS = (b"", b"-1", b"nan", b"inf", b"1e999", b"9" * 400, b"null", b"[]", b"{}", b"\x00", b"\xff", b"/etc/passwd")


def _at(rng: np.random.Generator, data: bytes, width: int = 1) -> int:
    """A place for ``width`` bytes; half of the time in the first 200 bytes, where headers are."""
    room = max(len(data) - width + 1, 1)
    return int(rng.integers(min(room, 200) if rng.random() < 0.5 else room))


def flip_bits(rng: np.random.Generator, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 2, 32]))):
        out[_at(rng, data)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def cut(rng: np.random.Generator, data: bytes) -> bytes:
    """The file ends early, or a block of it is lost or doubled."""
    a, b = sorted((_at(rng, data), _at(rng, data)))
    return (data[:a], data[:a] + data[b:], data[:b] + data[a:])[int(rng.integers(3))]


def number(rng: np.random.Generator, data: bytes) -> bytes:
    """A count, offset or value becomes an extreme one, of any width and byte order."""
    width, little = int(rng.choice([1, 2, 4, 8])), str(rng.choice(["little", "big"])) == "little"
    at, value = _at(rng, data, width), NUMBERS[int(rng.integers(len(NUMBERS)))]
    new = (value % (1 << 8 * width)).to_bytes(width, "little" if little else "big")
    if width >= 4 and rng.random() < 0.3:
        new = struct.pack("<f" if width == 4 else "<d", float(rng.choice([np.nan, np.inf, -np.inf, -1.0, 1e30])))
    return data[:at] + new + data[at + width :]


def word(rng: np.random.Generator, data: bytes) -> bytes:
    """A word or number of a text is lost, or becomes another."""
    words = list(re.finditer(rb"[A-Za-z_]+|[-+]?\d[\d.eE+-]*|[:,{}\[\]]", data))
    if not words:
        return flip_bits(rng, data)
    spot, other = (words[int(rng.integers(len(words)))] for _ in range(2))
    new = other[0] if rng.random() < 0.3 else TOKENS[int(rng.integers(len(TOKENS)))]
    return data[: spot.start()] + new + data[spot.end() :]


MUTATORS = (flip_bits, cut, number, number, word, word)


def mutant(name: str, whole: bytes, seed: int, index: int) -> bytes:
    """Mutant ``index`` of a format's whole file."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), index])
    return MUTATORS[int(rng.integers(len(MUTATORS)))](rng, whole)


def judge(read: Callable[[Path], object], path: Path) -> str:
    """READ, REFUSED, or what is wrong, in one line."""
    try:
        read(path)
    except (BlinkGLError, PermissionError, MemoryError) as error:
        text = str(error)
        return REFUSED if "\n" not in text and text.isprintable() else f"several lines: {text!r}"
    except BaseException as error:  # noqa: BLE001 - SystemExit is a defect, too
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}: {' '.join(str(error).split())}"
    return READ


def in_a_process(read: Callable[[Path], object], path: Path, longer: int = 1) -> str:
    """:func:`judge` in a child that may die or hang.   longer : so many times the limits of time."""
    receiver, sender = FORK.Pipe(duplex=False)
    sys.stdout.flush()
    child = FORK.Process(target=_answer, args=(sender, read, path, CPU_S * longer))
    child.start()
    sender.close()
    answered, text = receiver.poll(WALL_S * longer), ""
    with contextlib.suppress(EOFError):  # the child has died
        text = receiver.recv() if answered else ""
    if not answered:
        child.kill()
    child.join()
    if text:
        return text
    killed = not answered or child.exitcode == -signal.SIGXCPU
    return "hangs" if killed else f"the process ends with status {child.exitcode}"


def _answer(sender: Connection, read: Callable[[Path], object], path: Path, cpu_s: int) -> None:
    """Of the child: what is said of a file."""
    _limit(cpu_s)
    sender.send(judge(read, path)[:4000])
    os._exit(0)


def _limit(cpu_s: int) -> None:
    """Of the child: silence, and no more than so much time and memory."""
    faulthandler.disable()
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + (MEMORY_MB << 20),) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    used = resource.getrusage(resource.RUSAGE_SELF)
    resource.setrlimit(resource.RLIMIT_CPU, (int(used.ru_utime + used.ru_stime) + 1 + cpu_s, resource.RLIM_INFINITY))


def fuzz(name: str, indices: range | list[int], seed: int, keep: Path | None) -> Counter:
    """How many mutants of one format were read, refused or, by what is wrong, neither."""
    outcomes: Counter = Counter()
    with tempfile.TemporaryDirectory(prefix="blinkgl-fuzz-") as folder:
        path = Path(folder) / name
        format_ = FORMATS[name]
        format_.make(path)
        files = format_.files(path)
        if (first := judge(format_.read, path)) != READ:  # it also compiles what the children need
            raise RuntimeError(f"{name}: the whole file is not read: {first}")
        for index in indices:
            file = files[index % len(files)]
            whole = file.read_bytes()
            file.write_bytes(mutant(name, whole, seed, index))
            outcome = in_a_process(format_.read, path)
            outcomes[outcome] += 1
            if outcome not in (READ, REFUSED):
                again = f"python -m blinkgl.tools.fuzz {shlex.quote(name)} --seed {seed} --only {index}"
                print(f"{file.name}: {outcome}\n    {again}", flush=True)
                if keep is not None:
                    keep.write_bytes(file.read_bytes())
            file.write_bytes(whole)
    return outcomes


def configurations(indices: range | list[int], seed: int, keep: Path | None) -> Counter:
    """Draw configurations and run each: how many were generated and verified, refused or, by what is wrong, neither."""
    outcomes: Counter = Counter()
    for index in indices:
        with tempfile.TemporaryDirectory(prefix="blinkgl-fuzz-") as folder:
            path = Path(folder) / "run.yaml"
            path.write_bytes(fuzz_configurations.written(seed, index))
            outcome = in_a_process(fuzz_configurations.check, path, 10)  # a kernel may have to be compiled
            outcomes[outcome] += 1
            if outcome not in (READ, REFUSED):
                print(
                    f"{outcome}\n    python -m blinkgl.tools.fuzz configurations --seed {seed} --only {index}",
                    flush=True,
                )
                if keep is not None:
                    keep.write_bytes(path.read_bytes())
    return outcomes


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(FORMATS)}; default: all")
    parser.add_argument("--mutants", type=int, default=200, help="of each format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="this mutant alone")
    parser.add_argument("--keep", type=Path, help="file for the last mutant that shows a defect")
    options = parser.parse_args(arguments)
    indices = range(options.mutants) if options.only is None else [options.only]
    defects = 0
    for name in options.names or FORMATS:
        if name == "configurations":
            outcomes = configurations(indices, options.seed, options.keep)
        else:
            outcomes = fuzz(name, indices, options.seed, options.keep)
        wrong = outcomes.total() - outcomes[READ] - outcomes[REFUSED]
        defects += wrong
        print(f"{name:14} {outcomes[READ]:5} read {outcomes[REFUSED]:5} refused {wrong:5} defects", flush=True)
    return 1 if defects else 0


if __name__ == "__main__":
    sys.exit(main())
