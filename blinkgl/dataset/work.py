"""What every worker does, whoever started it: one process, one OpenGL context, one set of
numba threads, one sequence after another.

A :class:`Job` says what the run is; a :class:`Maker` turns task numbers into sequence directories and plain-data
messages (dicts that JSON can carry):

    {"kind": "hello", "pid", "environment", "assets"}          ready
    {"kind": "progress", "task", "frames", "events", "fraction", "seconds": by stage so far,
     "notes": what was guessed or is not drawn}
    {"kind": "said", "task", "text": a line for the user, about compiling}
    {"kind": "done", "task", "first": of this process, "report": {…}, "bytes", "cpu_s", "peak_rss_kib"}
    {"kind": "failed", "task", "error": one line, "expected": a BlinkGLError, "final": no use
    trying again, "stop": nor anything else}
"""

from __future__ import annotations

import errno
import hashlib
import importlib
import os
import platform
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from importlib import resources
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

from blinkgl.config.reader import parse_yaml
from blinkgl.config.run import RunTemplate
from blinkgl.dataset.assets import check_assets, digest, libraries
from blinkgl.dataset.generate import generate_sequence
from blinkgl.dataset.messages import Message, SequenceLog
from blinkgl.dataset.plan import Plan
from blinkgl.dataset.report import SequenceReport
from blinkgl.errors import BlinkGLError, ConfigError, OutputError, may_pass
from blinkgl.gl import GLContext, create_context
from blinkgl.machine.compiling import announced_compiling
from blinkgl.machine.plugins import load_plugins, plugin_versions
from blinkgl.machine.posix import peak_kib
from blinkgl.types.trees import Tree
from blinkgl.version import __version__

_NEWS_EVERY_S = 0.25

MAKES_BYTES = (
    *("camera", "config", "events", "gl", "imaging", "io", "labels", "render", "scene", "sequence", "sequence_files"),
    *("tensors", "timeline", "types", "errors.py", "rng.py", "srgb.py", "version.py"),
    *(f"dataset/{name}.py" for name in ("__init__", "assets", "generate", "plan", "report")),
    *(f"machine/{name}.py" for name in ("__init__", "closing", "compiling", "extras", "interrupts", "kernels")),
    *(f"machine/{name}.py" for name in ("plugins", "posix")),
    *(f"recordings/{name}.py" for name in ("__init__", "decoding", "fitting", "frame_checks", "frame_noise")),
    "recordings/simulation.py",
)
"""The code that can change a sequence's bytes: what ``generate_run`` imports (a test walks its imports). An edit of
anything else ends no run."""
SHIPPED_TABLES = "emulators", "quality", "rigs", "sensors"
"""Folders of ``configs/`` whose files a recipe uses by name, so that its hash does not cover them."""
NUMERICS = (
    *("numpy", "scipy", "numba", "llvmlite", "h5py", "hdf5plugin", "av", "pillow", "imageio", "tifffile", "trimesh"),
    *("mapbox_earcut", "python-fcl", "scikit-image", "matplotlib", "PyYAML"),
)
"""Distributions whose versions can change bytes, besides OpenCV, whose distribution has several names."""


@dataclass(frozen=True)
class Job:
    """A run, in plain data, as executors take it. ``out``: the folder of logs.   ``recipe``: YAML text (it keeps what
    JSON would not, such as integer keys)."""

    out: str
    base: str
    recipe: str
    num: int | None = None
    maker: ClassVar[str] = "blinkgl.dataset.work:Maker"
    """The class that makes its tasks, as "module:class": :func:`maker_of` finds it in a worker process."""

    def plan(self) -> Plan:
        return Plan.of(RunTemplate(parse_yaml(self.recipe, "recipe"), Path(self.base)), self.num)

    def to_dict(self) -> dict[str, object]:
        return asdict(self)


def maker_of(name: str, job: Mapping[str, object], device: int | None) -> Maker:
    """Return the maker called ``name`` ("module:class", of a job's ``maker``) for a job in plain data."""
    load_plugins()  # those of the process that started this one
    module, _, kind = name.partition(":")
    return getattr(importlib.import_module(module), kind).of(job, device)


def thread_environment(workers: int, cores: int) -> dict[str, str]:
    """Return variables of each of ``workers`` processes on ``cores`` cores: cores are divided, not oversubscribed.
    Variables set by the user are kept. Software OpenGL draws in the calling thread (LP_NUM_THREADS=0) if there are two
    workers or more (two processes then draw 1.2-1.35 times as fast as one with two threads), or one on a single
    core."""
    share = max(1, cores // max(1, workers))
    wanted = {"NUMBA_NUM_THREADS": str(share), "OMP_NUM_THREADS": str(share), "OPENBLAS_NUM_THREADS": str(share)}
    if workers > 1 or cores == 1:
        wanted["LP_NUM_THREADS"] = "0" if share == 1 else str(share)
    return {key: value for key, value in wanted.items() if key not in os.environ}


class Maker:
    """Makes the job's sequences in this process. Use as a context manager; ``open`` before ``make``."""

    def __init__(self, job: Job, device: int | None = None):
        self.job, self.device = job, device
        self.plan = job.plan()
        self.gl: GLContext | None = None
        self._first = True

    @classmethod
    def of(cls, job: Mapping[str, Any], device: int | None) -> Maker:
        """Return the maker of a job in plain data."""
        return cls(Job(**job), device)

    def open(self) -> Message:
        """Check the assets, make the OpenGL context, and return the hello. Raises BlinkGLError."""
        assets = check_assets(self.plan)
        rendered = [group.template.check() for group in self.plan.used]
        rendered = [config.gl for config in rendered if config.frames is None]
        if rendered:
            # A process has one context, which sequences of all groups share.
            if any(gl != rendered[0] for gl in rendered):
                raise ConfigError(
                    "the groups need different OpenGL implementations",
                    where="gl",
                    accepted="one gl section at the top level",
                )
            device = rendered[0].device if self.device is None else self.device
            self._context = partial(create_context, rendered[0].backend, device)
            self.gl = self._context()
        return {
            "kind": "hello",
            "pid": os.getpid(),
            "environment": environment(self.gl, libraries(self.plan)),
            "assets": digest(assets),
        }

    def renew(self) -> None:
        """Replace a lost context by a new one. Raises GLError: the GPU gives none."""
        if self.gl is not None and self.gl.lost:
            self.gl.release()
            self.gl = self._context()

    def make(self, number: int, attempt: int, tell: Callable[[Message], None]) -> Message:
        """Make the ``number``-th task of the plan. Returns "done" or "failed"; only KeyboardInterrupt and SystemExit
        are raised."""
        task = self.plan.tasks[number]
        log = SequenceLog(self.job.out, task.name)
        log.write(f"attempt {attempt}, pid {os.getpid()} on {platform.node()}")
        cpu = time.process_time()
        try:
            # A lost context fails its sequence; the next attempt begins with a new one.
            self.renew()
            config = self.plan.config(task)
            with announced_compiling(lambda text: tell({"kind": "said", "task": number, "text": text})):
                report = generate_sequence(
                    config,
                    task.index,
                    self.job.out,
                    self.gl,
                    base=Path(self.job.base),
                    progress=_progress(number, tell),
                )
        except (KeyboardInterrupt, SystemExit):
            log.write("interrupted")
            raise
        except Exception as error:  # noqa: BLE001 - whatever it is, the other sequences go on
            message = failed(number, error)
            log.write("failed: " + message["error"])
            log.write(traceback.format_exc())
            return message
        size = sum(p.stat().st_size for p in report.path.rglob("*") if p.is_file())
        log.write(
            f"done in {report.total_s:.2f} s: {report.frames} frames, {report.events} events, {report.labels} "
            f"labels, {size} bytes; " + ", ".join(f"{k} {v:.2f} s" for k, v in report.seconds.items())
        )
        first, self._first = self._first, False
        return {
            "kind": "done",
            "task": number,
            "first": first,
            "bytes": size,
            "cpu_s": time.process_time() - cpu,
            "peak_rss_kib": peak_kib(),
            "report": {**asdict(report), "path": str(report.path)},
        }

    def __enter__(self) -> Maker:
        return self

    def __exit__(self, *_: object) -> None:
        if self.gl is not None:
            self.gl.release()
            self.gl = None


def _progress(number: int, tell: Callable[[Message], None]) -> Callable[[SequenceReport, float], None]:
    """Return the listener that tells how far a sequence is."""
    last = 0.0

    def progress(report: SequenceReport, fraction: float) -> None:
        nonlocal last
        # There are hundreds of frames per second, and each message is a line of JSON through a pipe.
        if (now := time.monotonic()) - last > _NEWS_EVERY_S:
            last = now
            seconds, notes = dict(report.seconds), list(report.notes)
            made = {"frames": report.frames, "events": report.events, "fraction": fraction}
            tell({"kind": "progress", "task": number, **made, "seconds": seconds, "notes": notes})

    return progress


def failed(number: int, error: Exception) -> Message:
    """Return the "failed" of a task that ``error`` ended."""
    expected = isinstance(error, BlinkGLError)
    return {
        "kind": "failed",
        "task": number,
        "error": str(error) if expected else f"{type(error).__name__}: {' '.join(str(error).split())}",
        "expected": expected,
        "final": not may_pass(error),
        "stop": _disk_is_full(error),
    }


def report_of(message: Message) -> SequenceReport:
    """Return the report in a "done" message."""
    report: Tree = {**message["report"], "path": Path(message["report"]["path"])}
    return SequenceReport(**report)


def environment(gl: GLContext | None, libraries: Mapping[str, str] = MappingProxyType({})) -> dict[str, str]:
    """Return everything that affects the bytes: two machines with the same values make the same sequences.
    libraries : versions of those that not every run uses."""
    import cv2

    return {
        **_code(),
        "python": platform.python_version(),
        "machine": platform.machine(),
        **{name: _version(name) for name in NUMERICS},
        "opencv": cv2.__version__,
        "opengl": f"{gl.renderer}, {gl.version}" if gl is not None else "not used",
        **libraries,
        **plugin_versions(),
    }


def _version(library: str) -> str:
    """Return the version installed, "none" for one that a gzip set without a preview does without."""
    try:
        return version(library)
    except PackageNotFoundError:
        return "none"


def environment_differences(one: dict[str, str], other: dict[str, str]) -> str:
    """Return "numpy 2.4 and 2.3; …", empty when they are equal."""
    return "; ".join(f"{key} {one.get(key)} and {value}" for key, value in other.items() if one.get(key) != value)


@lru_cache(maxsize=1)
def _code() -> dict[str, str]:
    """Return the version, and 12 hex digits of each room of the running code: a version number does not identify a
    checkout. BLINKGL_BUILD replaces them (the tag of a container image; tests while the code is edited)."""
    if build := os.environ.get("BLINKGL_BUILD"):
        return {"blinkgl": f"{__version__} ({build})"}
    package, shaders, tables = (
        Path(str(resources.files(name))) for name in ("blinkgl", "blinkgl.shaders", "blinkgl.configs")
    )
    rooms = [(f"blinkgl/{name}", package / name) for name in MAKES_BYTES] + [("shaders", shaders)]
    rooms += [(f"configs/{name}", tables / name) for name in SHIPPED_TABLES]
    sums: Tree = {}
    for name, place in rooms:
        digest = sums.setdefault(
            f"code of {name.rpartition('/')[0] if name.endswith('.py') else name}", hashlib.sha256()
        )
        for path in [place] if place.is_file() else sorted(place.rglob("*")):
            if path.suffix in (".py", ".glsl", ".yaml"):
                digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return {"blinkgl": __version__, **{name: digest.hexdigest()[:12] for name, digest in sums.items()}}


def _disk_is_full(error: BaseException) -> bool:
    """Return whether the next sequence would fail in the same way: no space, no permission, a read-only file system."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES):
            return True
        if isinstance(cause, OutputError) and "no space" in cause.problem:
            return True
        cause = cause.__cause__
    # The operating system's error is often the cause of a BlinkGLError.
    return False
