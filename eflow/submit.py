"""Submission files of the DSEC and BlinkFlow benchmarks; a file appears only after it was checked."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.atomic import atomic_file
from blinkgl.io.flow import encode_flow_png
from blinkgl.io.images import encode_png
from eflow.data.sources import Entry, FolderSource, detect_format, open_source
from eflow.evaluate import answers
from eflow.infer import Predictor
from eflow.models import FlowModel
from eflow.types import Flow, Numbers

DSEC_SEQUENCES = (
    "interlaken_00_b",
    "interlaken_01_a",
    "thun_01_a",
    "thun_01_b",
    "zurich_city_12_a",
    "zurich_city_14_c",
    "zurich_city_15_a",
)
SAMPLED = 2502002
CELL = 4


@dataclass(frozen=True)
class Benchmark:
    """The files of a benchmark.

    name : of the file of a label.   encode : flow and the name of its file -> its bytes.   check : raises OutputError
    unless the bytes of a file hold flow of (height, width) px.   sequences : of the test set; empty: any."""

    compression: int
    name: Callable[[Entry], str]
    encode: Callable[[Flow, str], bytes]
    check: Callable[[bytes, str, tuple[int, int]], None]
    sequences: tuple[str, ...] = ()


def submit(
    model: FlowModel,
    root: str | os.PathLike,
    out: str | os.PathLike,
    *,
    warm_start: bool = False,
    views: int = 1,
    progress: Callable[[int, int], None] = lambda done, count: None,
) -> tuple[int, int]:
    """Write the zip of the benchmark whose layout the test set at ``root`` has, a file ``<sequence>/<name>`` for every
    label; return the number of files, and how many of them hold zero flow: a window has no events.

    Raises AssetError: no benchmark's layout, a test sequence is missing, or there are others. OutputError: the file
    exists, or its check failed (then nothing is written)."""
    if (layout := detect_format(Path(root))) not in BENCHMARKS:
        raise AssetError("not a benchmark's test set", where=str(root), value=layout, accepted=", ".join(BENCHMARKS))
    benchmark, source = BENCHMARKS[layout], open_source(root, layout)
    assert isinstance(source, FolderSource)
    # A server refuses an incomplete archive only after the upload.
    _check_sequences(source, benchmark.sequences, str(root))
    entries = [source.entry(i) for i in range(len(source))]
    names = [f"{sequence.name}/{benchmark.name(entry)}" for sequence, entry in entries]
    if len(set(names)) != len(names):
        raise AssetError("a file index is listed twice", where=str(root))
    sizes: dict[str, tuple[int, int]] = {}
    still = 0
    # Sizes differ between sequences, so the predictor learns them from each sample.
    predictor = Predictor(model, 0, 0, warm_start=warm_start, views=views)
    with atomic_file(out, overwrite=False) as temporary:
        with zipfile.ZipFile(temporary, "w", benchmark.compression) as archive:
            for i, sample, answer in answers(predictor, source, range(len(source))):
                _member(archive, names[i], benchmark.encode(answer.flow, names[i]))
                sizes[names[i]] = sample.height, sample.width
                still += not answer.flow.any()
                progress(i + 1, len(names))
        # Read again what was written, before it gets its name.
        check_archive(temporary, benchmark, sizes)
    return len(names), still


def _check_sequences(source: FolderSource, sequences: tuple[str, ...], where: str) -> None:
    there = {s.name for s in source.sequences}
    if not sequences or there == set(sequences):
        return
    missing, foreign = sorted(set(sequences) - there), sorted(there - set(sequences))
    raise AssetError(
        "not the benchmark's test sequences",
        where=where,
        value=(f"missing {missing[0]}" if missing else f"foreign {foreign[0]}"),
        accepted=f"exactly the {len(sequences)} test sequences",
    )


def check_archive(path: str | os.PathLike, benchmark: Benchmark, sizes: dict[str, tuple[int, int]]) -> None:
    """Raise OutputError unless the zip has exactly the files of ``sizes``, each with flow of its (height, width)."""
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        if sorted(names) != sorted(sizes):
            odd = sorted(set(names) ^ set(sizes)) or sorted(n for n in names if names.count(n) > 1)
            raise OutputError(
                "submission does not match the test set", where=str(path), value=odd[0], accepted=f"{len(sizes)} files"
            )
        for name in names:
            benchmark.check(archive.read(name), f"{path}: {name}", sizes[name])


def _dsec_png(flow: Flow, name: str) -> bytes:
    """Return a 16-bit PNG with the third channel 0, as the benchmark requires."""
    png, lost = encode_flow_png(flow, np.ones(flow.shape[:2], bool))
    if lost:
        raise OutputError(
            "flow that the submission format cannot hold",
            where=name,
            value=f"{lost} pixels",
            accepted="finite flow within ±256 px",
        )
    raw = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert raw is not None
    raw[..., 0] = 0  # BGR: blue is the third channel on disk
    return encode_png(raw)


def _check_png(data: bytes, where: str, size: tuple[int, int]) -> None:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != np.uint16 or image.shape != (*size, 3) or image[..., 0].any():
        raise OutputError(
            "submission holds a wrong image",
            where=where,
            value=None if image is None else (str(image.dtype), image.shape),
            accepted=f"16-bit RGB {size} with the third channel 0",
        )


def encode_sampled(flow: Flow, name: str) -> bytes:
    """Return int32 tag 2502002, int32 contains_vis = 0, int32 n, then n pairs (u, v) float32: the top-left pixel of
    every 4x4 cell, row-major. Raises OutputError: flow is not finite."""
    if not np.isfinite(flow).all():
        raise OutputError("flow is not finite", where=name)
    picked = np.ascontiguousarray(flow[::CELL, ::CELL], "<f4").reshape(-1, 2)
    return struct.pack("<iii", SAMPLED, 0, len(picked)) + picked.tobytes()


def decode(data: bytes) -> Numbers:
    """Return the flow of a file of :func:`encode_sampled`, (n, 2) float32 px. Raises AssetError."""
    try:
        tag, _, count = struct.unpack_from("<iii", data)
        if tag != SAMPLED:
            raise ValueError
        return np.frombuffer(data, "<f4", offset=12).reshape(count, 2)
    except (struct.error, ValueError):
        raise AssetError("not a BlinkFlow submission file", value=data[:12]) from None


def _check_sampled(data: bytes, where: str, size: tuple[int, int]) -> None:
    flow, cells = decode(data), -(-size[0] // CELL) * -(-size[1] // CELL)
    if flow.shape != (cells, 2) or not np.isfinite(flow).all():
        raise OutputError("submission holds a wrong file", where=where, value=flow.shape, accepted=str((cells, 2)))


def _member(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    # A fixed date: the same network and data give the same bytes.
    info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
    info.compress_type = archive.compression
    with archive.open(info, "w") as file:
        file.write(io.BytesIO(data).getbuffer())


BENCHMARKS = {
    "dsec": Benchmark(
        zipfile.ZIP_STORED, lambda entry: f"{entry.index:06d}.png", _dsec_png, _check_png, DSEC_SEQUENCES
    ),
    "blinkflow": Benchmark(
        zipfile.ZIP_DEFLATED,
        lambda entry: f"{entry.from_us // 1000:d}_{entry.to_us // 1000:d}.flo",
        encode_sampled,
        _check_sampled,
    ),
}
"""The benchmarks by the layout of their test sets (:func:`eflow.data.sources.detect_format`)."""
