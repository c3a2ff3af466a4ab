"""Comparison of event recordings with each other or with frames of their scene, or description of one.

Data stream interval by interval; memory is a few sensor-sized maps.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.columns import windows
from blinkgl.io.formats import ENDINGS, EventFile, ending_of, kind_of_files, open_events
from blinkgl.io.frames import CALLED, open_frames
from blinkgl.io.images import NpzReader, npy_header, numpy_errors
from blinkgl.io.reading import AS_FILE, NOTHING, Declared, EventReading, refuse_without_frames
from blinkgl.machine.kernels import kernel

IEI_EDGES_US = np.logspace(0, 7, 71)
"""Bins of the inter-event interval of a pixel: 1 µs to 10 s, ten per decade."""
LOG_OFFSET = 10.0
"""Added to the 8-bit code before the logarithm, so that the dark noise of real frames does not dominate."""
BLUR_PX = 1.0
"""Sigma of the Gaussian on both maps before a correlation, which removes single-event quantisation and sub-pixel
shifts."""


@dataclass(eq=False)
class RecordingSide:
    """One recording inside the compared time span. Maps are (H, W), times µs.

    rate_hz : (K,) events per second in each interval.   iei : (70,) inter-event intervals per bin of IEI_EDGES_US.
    frame_correlation : (K,) Pearson correlation over the pixels of the polarity sum with the change of ln(I + 10), both
    blurred by BLUR_PX.   implied_threshold : (K,) change of ln(I + 10) per event, slope through 0 of change on polarity
    sum."""

    name: str
    count: int = 0
    on: int = 0
    rate_hz: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    counts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.int64), repr=False)
    iei: np.ndarray = field(default_factory=lambda: np.zeros(len(IEI_EDGES_US) - 1, np.int64), repr=False)
    frame_correlation: np.ndarray | None = field(default=None, repr=False)
    implied_threshold: np.ndarray | None = field(default=None, repr=False)

    @property
    def size(self) -> str:
        """ "640x480", width first."""
        return f"{self.counts.shape[1]}x{self.counts.shape[0]}"

    @property
    def on_off_ratio(self) -> float:
        off = self.count - self.on
        return self.on / off if off else float("inf")

    @property
    def median_iei_us(self) -> float:
        if not self.iei.sum():
            return float("nan")
        i = int(np.searchsorted(np.cumsum(self.iei), self.iei.sum() / 2))
        # The geometric middle of the bin, as bins are equal on a logarithmic scale.
        return float(np.sqrt(IEI_EDGES_US[i] * IEI_EDGES_US[i + 1]))


@dataclass(eq=False)
class Comparison:
    """Result of :func:`compare`. ``b`` is None when there was one recording. Pixel-wise results are None where the two
    differ in size.

    pixel_correlation : Pearson correlation over the pixels of the event counts of a and b.   polarity_correlation :
    (K,) the same of their blurred polarity sums in each interval.   notes : what was guessed, left out or unusual when
    files and frames were read, a line each."""

    edges_us: np.ndarray
    a: RecordingSide
    b: RecordingSide | None
    pixel_correlation: float | None = None
    polarity_correlation: np.ndarray | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def same_size(self) -> bool:
        """Return whether the pixels of two recordings can be compared one by one."""
        return self.b is not None and self.a.counts.shape == self.b.counts.shape

    @property
    def duration_s(self) -> float:
        return (self.edges_us[-1] - self.edges_us[0]) * 1e-6

    @property
    def rate_ratio(self) -> np.ndarray:
        """Return events of b per event of a, (K,); NaN where a has none."""
        assert self.b is not None
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.a.rate_hz > 0, self.b.rate_hz / self.a.rate_hz, np.nan)

    @property
    def iei_distance(self) -> float:
        """Return the largest difference of the two cumulative distributions of the inter-event interval
        (Kolmogorov-Smirnov distance)."""
        assert self.b is not None
        return histogram_distance(self.a.iei, self.b.iei)

    def rows(self) -> list[tuple[str, ...]]:
        """Return (quantity, a, b) as text, for a table; quantities of the pair are in the last column."""
        sides = [self.a] + ([self.b] if self.b else [])
        spread = lambda values: _spread(values, np.diff(self.edges_us))
        each = lambda text: tuple(text(s) for s in sides) + ("",) * (2 - len(sides))
        rows: list[tuple[str, ...]] = [
            ("sensor", *each(lambda s: s.size)),
            ("events", *each(lambda s: f"{s.count:,}")),
            ("rate", *each(lambda s: f"{s.count / self.duration_s / 1e6:.4g} M/s")),
            ("rate of a pixel", *each(lambda s: f"{s.count / self.duration_s / s.counts.size:.4g} Hz")),
            ("ON / OFF", *each(lambda s: f"{s.on_off_ratio:.3f}")),
            ("active pixels", *each(lambda s: f"{100 * np.mean(s.counts > 0):.1f} %")),
            ("median interval of a pixel", *each(lambda s: f"{s.median_iei_us / 1000:.3g} ms")),
        ]
        if self.a.frame_correlation is not None:
            rows += [
                ("polarity sum : Δ ln(I+10), correlation", *each(lambda s: spread(s.frame_correlation))),
                ("implied contrast threshold", *each(lambda s: spread(s.implied_threshold))),
            ]
        if self.b:
            rows += [("event-rate ratio B / A per interval", "", spread(self.rate_ratio))]
            if self.same_size:
                rows += [
                    ("polarity sums A : B per interval, correlation", "", spread(self.polarity_correlation)),
                    ("event counts per pixel A : B, correlation", "", f"{self.pixel_correlation:.3f}"),
                ]
            rows += [("interval distribution, KS distance", "", f"{self.iei_distance:.3f}")]
        return rows

    def to_dict(self) -> dict[str, object]:
        """Return plain numbers and lists (without maps), for JSON."""

        def side(s: RecordingSide) -> dict:
            return {k: _plain(v) for k, v in asdict(s).items() if k != "counts"} | {
                "size": s.size,
                "on_off_ratio": _plain(s.on_off_ratio),
                "median_iei_us": _plain(s.median_iei_us),
            }

        pair = (
            {}
            if self.b is None
            else {
                "b": side(self.b),
                "rate_ratio": _plain(self.rate_ratio),
                "pixel_correlation": _plain(self.pixel_correlation),
                "polarity_correlation": _plain(self.polarity_correlation),
                "iei_distance": _plain(self.iei_distance),
            }
        )
        return {
            "edges_us": _plain(self.edges_us),
            "duration_s": self.duration_s,
            "iei_edges_us": _plain(IEI_EDGES_US),
            "a": side(self.a),
            **pair,
        }


def compare(
    a: str | os.PathLike,
    b: str | os.PathLike | None = None,
    *,
    frames: str | os.PathLike | None = None,
    declared: Declared = NOTHING,
    gamma: str | float | None = None,
    frame_delay_ms: float = 0.0,
    interval_ms: float = 20.0,
    zero_time: bool = False,
    reading: EventReading = AS_FILE,
) -> Comparison:
    """Compare event file ``a`` with event file ``b``, with ``frames``, or with both, over their common time; alone,
    ``a`` is described.

    Recordings of different sensor sizes are described side by side; pixel-wise results are then None.

    Intervals are those between frames where frames are given, else ``interval_ms``. ``b`` may itself be frames (a
    folder, video, .npy of frames): anything that is not an event file. declared : what the user says of the frames.
    gamma : of their codes; None: as of :func:`~blinkgl.recordings.decoding.meaning`, where grey images count as the
    camera's own, whose codes are intensities.
    frame_delay_ms : added to the frames' times; a stamp of the exposure's start is before its centre. zero_time : count
    both recordings from their first event, and frames from the first of them. reading : what is declared
    of both event files.

    Raises EventDataError: frames of another size than a recording, no common time.
    AssetError: unreadable.
    """
    if b is not None and frames is None and not _is_event_file(Path(b), declared.stream):
        b, frames = None, b
    if frames is None:
        refuse_without_frames(declared, gamma, frame_delay_ms or None)
    files = [open_events(p, reading).sized() for p in ((a,) if b is None else (a, b))]
    spans = [_span(f) for f in files]
    shifts = [s[0] if zero_time else 0 for s in spans]
    start, stop = max(s[0] - d for s, d in zip(spans, shifts)), min(s[1] - d for s, d in zip(spans, shifts))
    changes: Iterator[np.ndarray | None]
    notes: list[str] = []
    if frames is not None:
        zero = replace(declared, zero_time=zero_time or declared.zero_time)
        edges, changes, notes = _frame_intervals(frames, zero, gamma, round(frame_delay_ms * 1000), start, stop, files)
    else:
        step = round(interval_ms * 1000)
        # What remains at the end is an interval of its own length, or lengthens the last one.
        count = max(round((stop - start) / step), 1) if stop > start else 0
        edges = np.append(start + np.arange(count) * step, stop) if count else np.empty(0, np.int64)
        changes = iter([None] * count)
    if len(edges) < 2:
        raise EventDataError(
            "no common time",
            where=", ".join(str(f.path) for f in files),
            value=[tuple(round((t - d) / 1e6, 6) for t in s) for s, d in zip(spans, shifts)],
            accepted="recordings that overlap (seconds shown), or --zero-time",
        )
    result = _accumulate(files, shifts, edges, changes)
    result.notes += [f"{file.path}: {line}" for file in files for line in file.notes] + notes
    return result


def _accumulate(
    files: list[EventFile], shifts: list[int], edges: np.ndarray, changes: Iterator[np.ndarray | None]
) -> Comparison:
    shapes, intervals = [(int(f.height or 0), int(f.width or 0)) for f in files], len(edges) - 1
    same = len(files) == 2 and shapes[0] == shapes[1]
    sides = [
        RecordingSide(
            str(f.path),
            counts=np.zeros(shape, np.int64),
            rate_hz=np.zeros(intervals),
            iei=np.zeros(len(IEI_EDGES_US) - 1, np.int64),
        )
        for f, shape in zip(files, shapes)
    ]
    # -1: the pixel has had no event yet.
    last = [np.full(shape, -1, np.int64) for shape in shapes]
    polarity = np.full(intervals, np.nan)
    frame_correlation = np.full((len(files), intervals), np.nan)
    threshold = np.full((len(files), intervals), np.nan)
    with_frames = False
    streams = [windows(f.chunks(), edges + d) for f, d in zip(files, shifts)]
    for k, (change, *events) in enumerate(zip(changes, *streams)):
        sums = [np.zeros(shape, np.int32) for shape in shapes]
        for i, (side, e) in enumerate(zip(sides, events)):
            side.count += len(e)
            side.on += int(np.count_nonzero(e.p))
            side.rate_hz[k] = len(e) / ((edges[k + 1] - edges[k]) * 1e-6)
            _collect(e.x, e.y, e.t, e.p, edges[0] + shifts[i], side.counts, sums[i], last[i], side.iei)
        smooth = [_blurred(s) for s in sums] if same or change is not None else []
        if change is not None:
            with_frames = True
            change = _blurred(change)
            for i, s in enumerate(smooth):
                frame_correlation[i, k] = _correlation(s, change)
                square = float(np.sum(s * s))
                # The slope of a line through 0, by least squares.
                threshold[i, k] = float(np.sum(s * change)) / square if square else np.nan
        if same:
            polarity[k] = _correlation(*smooth)
    if with_frames:
        for i, side in enumerate(sides):
            side.frame_correlation, side.implied_threshold = frame_correlation[i], threshold[i]
    if len(files) == 1:
        return Comparison(edges, sides[0], None)
    a, b = sides
    if not same:
        return Comparison(edges, a, b)
    together = _correlation(a.counts, b.counts)
    return Comparison(edges, a, b, pixel_correlation=together, polarity_correlation=polarity)


@kernel
def _collect(x, y, t, p, origin, counts, sums, last, iei):
    """Add events to the count and polarity maps and to the histogram of inter-event intervals (ten bins per decade of
    µs)."""
    for i in range(len(t)):
        r, c = y[i], x[i]
        counts[r, c] += 1
        # +1 for ON, -1 for OFF: the sum follows the change of the logarithm.
        sums[r, c] += 2 * np.int32(p[i]) - 1
        now = t[i] - origin
        if last[r, c] >= 0:
            # 1e-9, so that the rounded logarithm of a bin's first value is not in the bin below.
            k = int(10 * np.log10(max(now - last[r, c], 1)) + 1e-9)
            iei[min(k, len(iei) - 1)] += 1
        last[r, c] = now


def _span(file: EventFile) -> tuple[int, int]:
    """Return the first event's time and one past the last's."""
    first, end = None, 0
    for chunk in file.chunks():
        first = int(chunk.t[0]) if first is None else first
        end = int(chunk.t[-1]) + 1
    if first is None:
        raise EventDataError("no events", where=str(file.path))
    return first, end


def _frame_intervals(
    path: str | os.PathLike,
    declared: Declared,
    gamma: str | float | None,
    delay_us: int,
    start: int,
    stop: int,
    files: list[EventFile],
) -> tuple[np.ndarray, Iterator[np.ndarray], list[str]]:
    """Return the edges (µs) of the frame intervals inside [start, stop), lazily the change of ln(I + 10) over each, and
    notes on the frames."""
    from blinkgl.recordings.decoding import Codes, OwnFrames, meaning

    for file in files:
        if Path(path) == file.path:  # the frames of the camera whose events are read
            declared = replace(declared, stream=file.reading.stream)
    source = open_frames(path, declared)
    if any((f.height, f.width) != (source.height, source.width) for f in files):
        sizes = "; ".join(
            f"{name}: {width}x{height}"
            for name, width, height in [
                (path, source.width, source.height),
                *((f.path, f.width, f.height) for f in files),
            ]
        )
        raise EventDataError(
            f"frames and recordings differ in size ({sizes})",
            where="compare",
            accepted="frames of the recordings' size",
        )
    times = np.array([t // 1000 + delay_us for _, t, _ in source], np.int64)
    inside = spanned(times, start, stop)
    if not len(inside):
        return np.empty(0, np.int64), iter(()), source.notes
    lo, hi = inside[0], inside[-1] + 1
    own = OwnFrames((source.height, source.width), "linear")
    codes = Codes(gamma, declared.white_level, declared.range, own).of(source)
    frame_codes = meaning(next(iter(source))[0], codes)

    def changes() -> Iterator[np.ndarray]:
        before = None
        for k, (frame, _, name) in enumerate(source):
            if lo <= k <= hi:
                # The offset is in 8-bit codes, so the luminance is scaled to them.
                log = np.log(frame_codes.decode(frame, name).astype(np.float64) * 255 + LOG_OFFSET)
                if before is not None:
                    yield log - before
                before = log

    return times[lo : hi + 1], changes(), [*source.notes, *frame_codes.notes]


def histogram_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the Kolmogorov-Smirnov distance of two histograms with the same bins."""
    return float(np.abs(np.cumsum(a) / max(a.sum(), 1) - np.cumsum(b) / max(b.sum(), 1)).max())


def spanned(times: np.ndarray, start: int, stop: int) -> np.ndarray:
    """Return the indices of the intervals between times (µs) that [start, stop) spans: the first may begin a little
    earlier, the last end a little later."""
    # A quarter of an interval: a recording is seldom cut where its frames are.
    slack = np.diff(times) // 4
    return np.flatnonzero((times[:-1] >= start - slack) & (times[1:] <= stop + slack))


def _blurred(values: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(values.astype(np.float64), (0, 0), BLUR_PX)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return Pearson's correlation over the pixels; NaN where one is constant."""
    a, b = a.ravel() - a.mean(), b.ravel() - b.mean()
    norm = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / norm) if norm > 0 else float("nan")


def _is_event_file(path: Path, stream: str | None) -> bool:
    if kind_of_files(path) or path.is_dir():
        return kind_of_files(path) is not None
    with contextlib.suppress(AssetError), numpy_errors(path):  # damaged: the reader reports it
        # Frames have three axes or more.
        if path.suffix.lower() == ".npz":
            with NpzReader(path) as arrays:
                held = arrays.shapes()[0]
                return not any(len(held[name][0]) >= 3 for name in (*CALLED, stream) if name in held)
        if path.suffix.lower() == ".npy":
            with open(path, "rb") as file:
                return len(npy_header(file, path.stat().st_size, str(path))[0]) < 3
    return ending_of(path) in ENDINGS


def _spread(values: np.ndarray, lengths: np.ndarray) -> str:
    """Return the mean over intervals, weighed by their lengths, the least and the largest value."""
    known = np.isfinite(values)
    values, lengths = values[known], lengths[known]
    return (
        f"{np.average(values, weights=lengths):.3f} ({np.min(values):.3f} … {np.max(values):.3f})"
        if len(values)
        else "–"
    )


def _plain(value: object) -> Any:
    if isinstance(value, np.ndarray):
        return [_plain(v) for v in value.tolist()]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
