"""Submission files of the DSEC and BlinkFlow benchmarks; a file appears only after it was checked."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.atomic import atomic_file
from blinkgl.io.flow import encode_flow_png
from blinkgl.io.images import encode_png
from eflow.data.dataset import FlowDataset, collate
from eflow.data.sources import FolderSource, open_source
from eflow.infer import WarmStart
from eflow.models import FlowModel

DSEC_SEQUENCES = (
    "interlaken_00_b",
    "interlaken_01_a",
    "thun_01_a",
    "thun_01_b",
    "zurich_city_12_a",
    "zurich_city_14_c",
    "zurich_city_15_a",
)
FULL, SAMPLED = 2502001, 2502002
CELL = 4
Progress = Callable[[int, int], None]


def submit_dsec(
    model: FlowModel,
    root: str | os.PathLike,
    out: str | os.PathLike,
    *,
    sequences: tuple[str, ...] = DSEC_SEQUENCES,
    precision: str = "fp32",
    warm_start: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write a zip of ``<sequence>/<file_index:06d>.png`` for every row of each test sequence's CSV; return the number
    of files.

    Raises AssetError: a test sequence is missing, or there are others. OutputError: the file exists, or its check
    failed (then nothing is written)."""
    source = open_source(root, "dsec")
    assert isinstance(source, FolderSource)
    found = {s.name for s in source.sequences}
    if found != set(sequences):
        missing, foreign = sorted(set(sequences) - found), sorted(found - set(sequences))
        raise AssetError(
            "not the benchmark's test sequences",
            where=str(root),
            value=(f"missing {missing[0]}" if missing else f"foreign {foreign[0]}"),
            accepted=f"exactly the {len(sequences)} test sequences",
        )
    wanted = {f"{source.entry(i)[0].name}/{source.entry(i)[1].index:06d}.png" for i in range(len(source))}
    if len(wanted) != len(source):
        raise AssetError("a file index is listed twice", where=str(root))
    with atomic_file(out, overwrite=False) as temporary:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
            for i, flow in _flows(model, source, precision, warm_start, progress):
                sequence, entry = source.entry(i)
                _member(
                    archive,
                    f"{sequence.name}/{entry.index:06d}.png",
                    _dsec_png(flow, f"{sequence.name}/{entry.index:06d}"),
                )
        check_dsec(temporary, wanted)
    return len(wanted)


def _dsec_png(flow: np.ndarray, name: str) -> bytes:
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


def check_dsec(path: str | os.PathLike, wanted: set[str], shape: tuple[int, int] = (480, 640)) -> None:
    """Raise OutputError unless the zip has exactly the files ``wanted``, each 16-bit RGB of ``shape`` with third
    channel 0."""
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        if sorted(names) != sorted(wanted):
            odd = sorted(set(names) ^ set(wanted)) or sorted(n for n in names if names.count(n) > 1)
            raise OutputError(
                "submission does not match the CSV", where=str(path), value=odd[0], accepted=f"{len(wanted)} files"
            )
        for name in names:
            image = cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_UNCHANGED)
            if image is None or image.dtype != np.uint16 or image.shape != (*shape, 3) or image[..., 0].any():
                raise OutputError(
                    "submission holds a wrong image",
                    where=f"{path}: {name}",
                    value=None if image is None else (str(image.dtype), image.shape),
                    accepted=f"16-bit RGB {shape} with the third channel 0",
                )


def submit_blinkflow(
    model: FlowModel,
    root: str | os.PathLike,
    out: str | os.PathLike,
    *,
    full: bool = False,
    precision: str = "fp32",
    warm_start: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write a zip of ``<scene>/<seq>/<t0 ms>_<t1 ms>.flo`` in the format of the benchmark, with one pixel per 4x4 cell
    unless ``full``; return the number of files. Raises as :func:`submit_dsec`."""
    source = open_source(root, "blinkflow")
    assert isinstance(source, FolderSource)
    name = lambda i: (
        f"{source.entry(i)[0].name}/{source.entry(i)[1].from_us // 1000:d}_{source.entry(i)[1].to_us // 1000:d}.flo"
    )
    wanted = {name(i) for i in range(len(source))}
    sizes: dict[str, tuple[int, int]] = {}
    with atomic_file(out, overwrite=False) as temporary:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for i, flow in _flows(model, source, precision, warm_start, progress):
                if not np.isfinite(flow).all():
                    raise OutputError("flow is not finite", where=name(i))
                _member(archive, name(i), encode_full(flow) if full else encode_sampled(flow))
                sizes[name(i)] = flow.shape[:2]
        with zipfile.ZipFile(temporary) as archive:
            if sorted(archive.namelist()) != sorted(wanted):
                raise OutputError(
                    "submission does not match the data set", where=str(out), accepted=f"{len(wanted)} files"
                )
            for member in wanted:
                decoded = decode(archive.read(member))
                expected = (*sizes[member], 2) if full else (cells(*sizes[member]), 2)
                if decoded.shape != expected or not np.isfinite(decoded).all():
                    raise OutputError(
                        "submission holds a wrong file", where=member, value=decoded.shape, accepted=str(expected)
                    )
    return len(wanted)


def cells(height: int, width: int) -> int:
    """Return the number of 4x4 cells of an image."""
    return -(-height // CELL) * -(-width // CELL)


def encode_full(flow: np.ndarray) -> bytes:
    """Return int32 tag 2502001, int32 width and height, then (H, W, 2) float32, little-endian."""
    return struct.pack("<iii", FULL, flow.shape[1], flow.shape[0]) + np.ascontiguousarray(flow, "<f4").tobytes()


def encode_sampled(flow: np.ndarray) -> bytes:
    """Return int32 tag 2502002, int32 contains_vis = 0, int32 n, then n pairs (u, v) float32: the top-left pixel of
    every 4x4 cell, row-major."""
    picked = np.ascontiguousarray(flow[::CELL, ::CELL], "<f4").reshape(-1, 2)
    return struct.pack("<iii", SAMPLED, 0, len(picked)) + picked.tobytes()


def decode(data: bytes) -> np.ndarray:
    """Return the flow of a file of either form, (H, W, 2) or (n, 2) float32. Raises AssetError."""
    try:
        tag, a, b = struct.unpack_from("<iii", data)
        shape = (b, a, 2) if tag == FULL else (b, 2)
        if tag not in (FULL, SAMPLED):
            raise ValueError
        return np.frombuffer(data, "<f4", offset=12).reshape(shape)
    except (struct.error, ValueError):
        raise AssetError("not a BlinkFlow submission file", value=data[:12]) from None


def _flows(
    model: FlowModel, source: FolderSource, precision: str, warm_start: bool, progress: Progress | None
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (number, flow) of every sample; with ``warm_start`` those that follow the one before start from its
    flow."""
    dataset, warm = FlowDataset([source], model.representation, raw=True, reads=model.reads), WarmStart(warm_start)
    for i in range(len(dataset)):
        sample = dataset[i]
        assert sample is not None  # empty windows are an error
        batch = collate([sample])
        raw = batch["raw"][0]
        yield i, warm.predict(model, batch, (raw.scene, raw.new.t0), (raw.scene, raw.new.t1), precision)
        if progress is not None:
            progress(i + 1, len(dataset))


def _member(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    # A fixed date: the same network and data give the same bytes.
    info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
    info.compress_type = archive.compression
    with archive.open(info, "w") as file:
        file.write(io.BytesIO(data).getbuffer())
