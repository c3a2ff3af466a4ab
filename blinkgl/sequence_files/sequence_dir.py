"""One generated sequence on disk: written aside, checksummed, synced, renamed; and its verification.

    <sequence>/
      events.h5                      DSEC layout (blinkgl.io.dsec)
      event_labels.h5                what made each event, a row per event (blinkgl.io.event_labels)    (on request)
      images/%06d.png                sRGB frames at label times;        images/timestamps.txt   one µs per line
      flow/forward/%06d.png          DSEC 16-bit flow;                  flow/forward_timestamps.txt   from_us,to_us
      flow/forward_npy/%06d.npy      float32 (H, W, 3) = u, v, valid    (as BlinkFlow's; on request)
      flow/forward_flo/%06d.flo                                         (on request)
      flow/backward…                 the same, from > to
      flow/intervals/%06d.h5         flow over intervals of one's own; occlusion/intervals/   (on request)
      occlusion/{forward,backward}/%06d.png   255 where the point is hidden at the other end
      depth/%06d.npy  velocity/%06d.npy  normals/%06d.npy  ids/%06d.png
      frame_camera/                  images with exposure and noise (blinkgl.io.sequence_tables)   (on request)
      imu/  tracks.npz               an inertial unit; point tracks (blinkgl.io.imu, .tracks; on request)
      lights.npz                     light that changes over time (blinkgl.io.sequence_tables)
      poses.npz  config.yaml  manifest.json  preview.mp4

Each label's row says its place (``blinkgl.labels``). DSEC's loaders take every file of ``flow/forward`` for a PNG.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.labels import LabelsConfig
from blinkgl.config.over_time import ImuConfig
from blinkgl.errors import AssetError, BlinkGLError, OutputError
from blinkgl.io import imu as imu_files
from blinkgl.io.atomic import fsync, make_folders, output_errors, refuse_existing, remove_stale, temporary_beside
from blinkgl.io.dsec import DsecEventWriter
from blinkgl.io.event_labels import EVENT_LABELS, EventLabelsWriter
from blinkgl.io.images import encode_image
from blinkgl.io.records import (
    SEAL,
    entries_below,
    open_regular,
    parse,
    read_text,
    seal_problem,
    sealed,
    shown,
)
from blinkgl.io.sequence_tables import CAMERA_STAMPS, EXPOSURES, ExposureLine, exposures_csv, picture_file, stamps_txt
from blinkgl.labels import Form, Label, label_of
from blinkgl.sequence_files.manifest import MODEL, RIG_MODEL
from blinkgl.types.events import Events
from blinkgl.types.trees import Tree

MANIFEST = "manifest.json"
RIG = "rig.yaml"
"""File in the folder of a sequence of several sensors (:mod:`blinkgl.sequence_files.rig_dir`)."""
_IN_FLIGHT = 8
"""Labels that wait for the encoder thread: limits memory to a few tens of MB."""


class SequenceWriter:
    """Context manager around one sequence directory. On success everything appears under ``final`` at once; on any
    exception (Ctrl-C and a full disk included) nothing does and the temporary is removed.

    Encoding and hashing run in one background thread, event compression in another; their errors surface in the next
    call or on exit. Arrays are copied, so callers may reuse read-back buffers.

    Parameters
    ----------
    final : the directory to make. An existing non-empty one is refused.
    height, width : sensor size, px; None: of several sensors, whose own writers are those of :meth:`of_camera`.
    config_yaml : resolved configuration, stored as ``config.yaml``.
    t_offset_us : time of the sequence's start, µs; events before it are refused by the DSEC format.
    labels : ``labels:``, which says in which forms labels are written; None: each in its first.
    events : False makes no ``events.h5``.
    truth : True makes ``event_labels.h5`` beside it, of events that say what made them; lights : also which light.
    codec : of ``events.h5``, "zstd", "lz4" or "gzip".

    Attributes
    ----------
    info : dict written into the manifest beside the checksums (seed, versions, GL renderer, counts). Keep wall-clock
        times out of it: the same seed shall give the same manifest.
    t_end_us : set it to the sequence's end, so that ``ms_to_idx`` covers an eventless tail.

    Raises
    ------
    OutputError : the directory exists, or cannot be written.
    """

    def __init__(
        self,
        final: str | os.PathLike,
        height: int | None,
        width: int | None,
        *,
        config_yaml: str,
        t_offset_us: int = 0,
        labels: LabelsConfig | None = None,
        events: bool = True,
        truth: bool = False,
        lights: bool = False,
        codec: str = "zstd",
    ):
        self.final = Path(final)
        self.height, self.width = height, width
        self.config_yaml, self.t_offset_us = config_yaml, int(t_offset_us)
        self.labels = labels
        self.info: Tree = {}
        self.t_end_us: int | None = None
        self.lost: dict[str, int] = {}
        self._with_events, self._with_truth, self.codec = events, truth, codec
        self._with_lights = lights
        self._files: dict[str, Tree] = {}
        self._promised = {name for name, on in (("events.h5", events), (EVENT_LABELS, truth)) if on}
        self._timestamps: dict[str, list[str]] = {}
        self._exposures: list[ExposureLine] = []
        self._failure: list[BaseException] = []
        self._whole: SequenceWriter | None = None
        self._count = 0

    def of_camera(self, name: str, height: int, width: int, **settings: Any) -> SequenceWriter:
        """Return the writer of a camera's own sequence, in the folder ``name`` of this one, which lists its files, too,
        with their checksums. settings : as of the constructor."""
        own = SequenceWriter(self.path(name), height, width, config_yaml=self.config_yaml, **settings)
        own.info["sensor"], own._whole = name, self
        return own

    def __enter__(self) -> SequenceWriter:
        refuse_existing(self.final)
        with output_errors(self.final):
            make_folders(self.final.parent)
            remove_stale(self.final.parent)
            # Beside the final name, on the same file system, so that the last step is one rename.
            self._tmp = temporary_beside(self.final)
            self._tmp.mkdir()
        # One thread: files are written in the given order, while the next frame is drawn.
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="sequence-writer")
        # Memory is limited: drawing waits when the disk is this many files behind.
        self._slots = threading.BoundedSemaphore(_IN_FLIGHT)
        self._truth: EventLabelsWriter | None = None
        self._events: DsecEventWriter | None = None
        try:
            if self._with_truth:
                self._truth = EventLabelsWriter(self._tmp / EVENT_LABELS, codec=self.codec, lights=self._with_lights)
            if self._with_events:
                assert self.height is not None and self.width is not None
                place = self._tmp / "events.h5"
                self._events = DsecEventWriter(place, self.height, self.width, self.t_offset_us, codec=self.codec)
        except BaseException:
            self._discard()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if kind is None:
            try:
                self._finish()
                return
            except BaseException as failure:  # noqa: BLE001 - Ctrl-C while flushing leaves nothing either
                error = failure
        self._discard()
        if isinstance(error, OutputError) and str(self._tmp) in (error.where or ""):
            # The user knows the final name, not the temporary's.
            where = str(error.where).replace(str(self._tmp), str(self.final))
            raise OutputError(error.problem, where=where, accepted=error.accepted) from error
        if kind is None and error is not None:
            raise error

    # ---- what a sequence consists of -------------------------------------------------------------------------

    def append_events(self, events: Events) -> None:
        """Append the next events, in time order (µs on the sequence's clock)."""
        self._check()
        assert self._events is not None, "of a sequence without events"
        self._events.append(events)
        if self._truth is not None and len(events):
            # A copy: the thread writes them after the caller has continued.
            self._submit(partial(self._truth.append, events.copy()))

    def label(self, name: str, index: int, value: object, t_us: int, to_us: int | None = None) -> None:
        """Write the ``index``-th value of a label (:mod:`blinkgl.labels`) at ``t_us``; ``to_us``: its other time, if it
        has one. Pixels that a format cannot hold are counted in ``lost`` and the manifest. Raises TypeError: a value of
        another shape or number type."""
        label = label_of(name)
        assert self.height is not None and self.width is not None, "a rig's own folder has no labels"
        if (wrong := label.wrong(value, self.height, self.width)) is not None:
            raise TypeError(f"label '{name}': {wrong}")
        value = label.own(value)
        if label.stamps is not None and label.towards is None:
            self._stamp(label.stamps, str(int(t_us)))
        elif label.stamps is not None:
            assert to_us is not None
            self._stamp(label.stamps, f"{int(t_us)}, {int(to_us)}", "# from_timestamp_us, to_timestamp_us")
        # Without a configuration (a test, a converter) only a label's first format is written.
        for form in label.forms[:1] if self.labels is None else label.written(self.labels):
            self._write(form.file(index), partial(self._encoded, label, form, value))

    def arrays(self, name: str, **arrays: np.ndarray) -> None:
        """Write named numeric arrays as ``name``, an .npz file."""
        columns: dict[str, Any] = {k: np.array(v) for k, v in arrays.items()}
        if bad := [k for k, v in columns.items() if v.dtype.hasobject]:
            raise TypeError(f"{name}: object arrays would be pickled: {bad}")

        def save(path: Path) -> None:
            with open(
                path, "wb"
            ) as file:  # NumPy stamps zip members 1980-01-01, so the bytes do not depend on the clock
                np.savez(file, **columns)

        self.external(name, save)

    def imu(self, config: ImuConfig, measured: Mapping[str, np.ndarray], folder: str = "") -> None:
        """Write ``imu/``: the measurements of an inertial unit, the arrays of
        :class:`~blinkgl.sequence.inertial.Inertial` by name.
        folder : of a rig's separate unit, ending with "/"."""
        noisy, ideal = (
            tuple(measured[name] for name in names)
            for names in (("t_ns", "rate", "acceleration"), ("t_ns", "ideal_rate", "ideal_acceleration"))
        )
        self.text(folder + imu_files.CSV, imu_files.imu_csv(*noisy))
        self.text(folder + imu_files.IDEAL, imu_files.imu_csv(*ideal))
        self._write(folder + imu_files.H5, partial(imu_files.imu_h5, measured))
        self.text(folder + imu_files.KALIBR, imu_files.kalibr_yaml(config, measured["T_cam_imu"]))

    def image(self, pictures: Mapping[str, np.ndarray], exposure: ExposureLine) -> None:
        """Write the next image of the frame camera: codes of "images" and what is written beside it
        (:mod:`blinkgl.io.sequence_tables`); the arrays must not be changed afterwards."""
        for picture, codes in pictures.items():
            self._write(picture_file(picture, len(self._exposures)), partial(encode_image, codes))
        self._exposures.append(exposure)

    def text(self, name: str, content: str) -> None:
        """Write a UTF-8 text file at ``name`` inside the sequence."""
        self._write(name, content.encode)

    def path(self, name: str) -> Path:
        """Return the path where another writer (the preview's) may put ``name`` before exit; it is checksummed on
        exit."""
        path = self._tmp / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def external(self, name: str, save: Callable[[Path], None]) -> None:
        """Run ``save(path)`` in the background thread."""

        def task() -> None:
            path = self.path(name)
            with output_errors(path):
                save(path)

        self._promised.add(name)
        self._submit(task)

    # ---- machinery -------------------------------------------------------------------------------------------

    def _encoded(self, label: Label, form: Form, value: object) -> bytes:
        assert form.encode is not None
        data = form.encode(value)
        if isinstance(data, tuple):
            data, lost = data
            way = label.towards or label.name
            self.lost[way] = self.lost.get(way, 0) + lost
        return data

    def _stamp(self, name: str, line: str, header: str | None = None) -> None:
        self._timestamps.setdefault(name, [header] if header else []).append(line)

    def _write(self, name: str, encode: Callable[[], bytes]) -> None:
        def task() -> None:
            data = encode()
            path = self.path(name)
            with output_errors(path), open(path, "wb") as file:
                file.write(data)
                file.flush()
                # The contents must reach the disk before the rename at the end.
                os.fsync(file.fileno())
            # Hashed from memory: reading it back would give the disk's content, not the intended one.
            self._files[name] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}

        self._submit(task)

    def _submit(self, task: Callable[[], None]) -> None:
        self._check()
        # Bounds the frames that wait to be written, and with them the memory.
        self._slots.acquire()
        self._pool.submit(task).add_done_callback(self._done)

    def _done(self, future: Future) -> None:
        self._slots.release()
        # Raised by the next call, because the other thread cannot report it.
        if not future.cancelled() and (error := future.exception()) is not None:
            self._failure.append(error)

    def _check(self) -> None:
        if self._failure:
            raise self._failure[0]

    def _finish(self) -> None:
        self._check()
        for name, lines in self._timestamps.items():
            self.text(name, "\n".join(lines) + "\n")
        if self._exposures:
            self.text(CAMERA_STAMPS, stamps_txt(self._exposures))
            self.text(EXPOSURES, exposures_csv(self._exposures))
        self.text("config.yaml", self.config_yaml)
        if self._events is not None:
            self._events.close(self.t_end_us)
        if self._truth is not None:
            self._submit(self._truth.close)
        # From here on every file exists, or the check raises the error that stopped it.
        self._pool.shutdown(wait=True)
        self._check()
        with output_errors(self.final):
            self._check_untouched()
            # Files of other writers: events.h5, the preview, arrays.
            for path in sorted(self._tmp.rglob("*")):
                name = path.relative_to(self._tmp).as_posix()
                if path.is_file() and name not in self._files:
                    fsync(path)
                    self._files[name] = digest_of(path)
            about = {"format_version": 2, **self._about(), **self.info}
            manifest = {**about, "files": self._files}
            path = self._tmp / MANIFEST
            path.write_text(sealed(manifest, default=_plain), encoding="utf-8")
            fsync(path)
            # Deepest first: an entry is durable when its folder is.
            for folder in sorted({p.parent for p in self._tmp.rglob("*")}, reverse=True):
                fsync(folder)
            # Again: something may have been put there while the sequence was made.
            refuse_existing(self.final)
            os.rename(self._tmp, self.final)
            fsync(self.final.parent)
            if self._whole is not None:
                self._whole.adopt(self)

    def _about(self) -> Tree:
        """Return the manifest's entries for this kind."""
        if self.height is None:
            return {"format": "blinkgl-rig", "t_offset_us": self.t_offset_us, "events": self._count}
        return {
            "format": "blinkgl-sequence",
            "height": self.height,
            "width": self.width,
            "t_offset_us": self.t_offset_us,
            "events": self._events.count if self._events is not None else 0,
            "flow_pixels_out_of_range": self.lost,
        }

    def adopt(self, own: SequenceWriter) -> None:
        """List the files of a camera's complete sequence."""
        name = own.final.name
        self._files |= {f"{name}/{file}": known for file, known in own._files.items()}
        self._files[f"{name}/{MANIFEST}"] = digest_of(own.final / MANIFEST)
        self._count += own._about()["events"]

    def _check_untouched(self) -> None:
        """Raise OutputError when a written file is missing or truncated because something else changed the folder."""
        sizes = {
            name: path.stat().st_size if (path := self._tmp / name).is_file() else None
            for name in self._promised | self._files.keys()
        }
        for name, size in sorted(sizes.items()):
            if size is None or size != self._files.get(name, {"bytes": size})["bytes"]:
                raise OutputError(
                    f"{name} was deleted or changed while the sequence was written",
                    where=str(self.final),
                    accepted="a folder that no other program writes to",
                )

    def _discard(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)
        if self._events is not None:
            self._events.abort()
        if self._truth is not None:
            self._truth.abort()
        shutil.rmtree(self._tmp, ignore_errors=True)


def is_rig_folder(folder: str | os.PathLike) -> bool:
    """Return whether a folder is the sequence of a rig, with those of its cameras in it."""
    return (Path(folder) / RIG).is_file()


def verify_sequence(folder: str | os.PathLike, *, checksums: bool = True) -> list[str]:
    """Return the problems of a sequence directory against its manifest, one line each; empty when complete.

    Finds missing, foreign, truncated and altered files, and entries that are not files: links, pipes, devices, empty
    folders. An unreadable manifest is one problem. ``checksums=False`` reads no contents, so it misses files altered
    without a change of length."""
    folder = Path(folder)
    try:
        # Both directions: what the manifest names and is not there, and what is there without being named.
        files = read_manifest(folder)["files"]
        present = {name: (kind, size) for name, kind, size in entries_below(folder)}
    except BlinkGLError as error:
        return [str(error)]
    except OSError as error:
        return [f"{shown(error.filename)}: cannot be read: {error.strerror}"]
    problems = []
    for name, expected in sorted(files.items()):
        kind, size = present.get(name, ("", 0))
        if kind != "file":
            problems += [f"{shown(name)}: missing"] if not kind else []
        # Sizes first, since a sum reads the whole file.
        elif size != expected["bytes"]:
            problems.append(f"{shown(name)}: {size} bytes, manifest says {expected['bytes']}")
        elif checksums:
            try:
                if digest_of(folder / name)["sha256"] != expected["sha256"]:
                    problems.append(f"{shown(name)}: checksum differs")
            except (OSError, BlinkGLError) as error:
                problems.append(f"{shown(name)}: cannot be read: {getattr(error, 'strerror', error)}")
    for name, (kind, _) in sorted(present.items()):
        if kind != "file":
            problems.append(f"{shown(name)}: a {kind}" if kind[0] != "e" else f"{shown(name)}: an {kind}")
        elif name not in files and name != MANIFEST:
            problems.append(f"{shown(name)}: not in the manifest")
    return problems


def read_manifest(folder: str | os.PathLike) -> Tree:
    """Return the manifest, in the form of :mod:`blinkgl.sequence_files.manifest`. Raises AssetError: there is none, or
    it is damaged."""
    path = Path(folder) / MANIFEST
    try:
        text = read_text(path)
        data = parse(text)
        rig = isinstance(data, dict) and data.get("format") == "blinkgl-rig"
        return parse(text, RIG_MODEL if rig else MODEL)
    except FileNotFoundError:
        raise AssetError("no manifest", where=str(path)) from None
    except ValueError as error:
        raise AssetError(f"damaged manifest: {error}", where=str(path)) from None


def whole(folder: str | os.PathLike) -> Tree:
    """Return the manifest of a sequence whose files are those that it lists, as far as their sizes tell. Raises
    AssetError: none, or damaged."""
    if problems := verify_sequence(folder, checksums=False):
        raise AssetError(
            f"damaged sequence: {problems[0]}", where=str(folder), accepted="a data set that 'blinkgl verify' passes"
        )
    return read_manifest(folder)


def manifest_problems(folder: str | os.PathLike) -> list[str]:
    """Return whether a manifest is what was written, by its hash of itself. Those of format_version 1 have none."""
    text = read_text(Path(folder) / MANIFEST)
    record = parse(text)
    if record["format_version"] == 1 and SEAL not in record:
        return []
    problem = seal_problem(text)
    return [] if problem is None else [f"{MANIFEST}: {problem}"]


def digest_of(path: Path) -> Tree:
    """Return a file's line in a manifest."""
    with open(open_regular(path), "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return {"bytes": file.tell(), "sha256": digest}


def _plain(value: object) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"manifest: {type(value).__name__} is not plain data")
