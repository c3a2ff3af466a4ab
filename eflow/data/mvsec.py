"""MVSEC as samples: pairs of images, dt = 1 or 4 apart, with ground truth propagated through the 20 Hz flow (Zhu et
al., RSS 2018), or with the pairs, rows and ground truth of published tables (:data:`PROTOCOLS`)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError, ConfigError, EventDataError
from blinkgl.io.columns import check_events, events_of, microseconds
from blinkgl.io.hdf5 import Data, Group, Hdf5File, dataset, open_hdf5
from blinkgl.io.hdf5_tables import MVSEC_EVENTS
from blinkgl.io.images import NpzReader, numpy_errors
from blinkgl.types.recent import Recent
from eflow.data.folders import below
from eflow.data.window import RawSample, Window
from eflow.types import Flow, Mask, Numbers, Times

HEIGHT, WIDTH = 260, 346
CROP = 256
HOOD_ROW = 193
"""First row that shows the hood of the car, outdoors."""
TRUTHS = ("propagated", "scaled")
"""Ground truth over a time that is not an interval of the 20 Hz flow. "propagated": pixels are followed through the
successive fields. "scaled", for a time shorter than an interval, as in the code of the published tables: the field at
its start, times the share of its interval, even if the time extends into the next interval. They differ by 0.10 to
0.23 px."""


@dataclass(frozen=True)
class Protocol:
    """The samples and rows that a published table scores.

    at : samples at "images", dt apart, or at the time stamps of the "flow" (20 Hz).
    frames : for a sequence, the ranges [first, end) of scored images or flow fields; other sequences are scored whole.
    hood : first row that is not scored outdoors.   truth : of :data:`TRUTHS`."""

    at: str = "images"
    frames: dict[str, tuple[tuple[int, int], ...]] = field(default_factory=dict)
    hood: int = HOOD_ROW
    truth: str = "propagated"


PROTOCOLS = {
    "all": Protocol(),
    "ste-flownet": Protocol(frames={"outdoor_day1": ((9200, 9600), (10500, 10900))}, hood=192, truth="scaled"),
    "e-raft": Protocol(at="flow", frames={"outdoor_day1": ((4356, 4706),)}),
}
"""``all``: every pair with ground truth. ``ste-flownet``: the images of outdoor_day1 in the tables of Spike-FlowNet and
STE-FlowNet, whose centre crop ends above row 192. ``e-raft``: 20 Hz, as in E-RAFT's table."""


class NpzTruth:
    """The 20 Hz flow of ``<seq>_gt_flow_dist.npz``. times : (N,) s. Raises AssetError."""

    _PARTS = ("x_flow_dist", "y_flow_dist")

    def __init__(self, path: Path):
        self.path, names = path, ("timestamps", *self._PARTS)
        with numpy_errors(path), NpzReader(path) as file:
            if missing := [name for name in names if name not in file]:
                raise AssetError(f"no array '{missing[0]}'", where=str(path), accepted=", ".join(names))
            shapes = {name: file.header(name)[0] for name in names}
            self.times = file["timestamps"]
        for name in self._PARTS:
            if shapes[name] != (expected := (len(self.times), HEIGHT, WIDTH)):
                raise AssetError(
                    f"array '{name}' has the wrong shape", where=str(path), value=shapes[name], accepted=str(expected)
                )

    def field(self, k: int) -> Flow:
        """Return field k, (H, W, 2) float32 px."""
        with numpy_errors(self.path), NpzReader(self.path) as file:
            return np.stack([file.row(name, k).astype(np.float32) for name in self._PARTS], axis=-1)


class Hdf5Truth:
    """The same of ``<seq>_gt.hdf5``. times : (N,) s. Raises AssetError."""

    def __init__(self, path: Path):
        self.path = path
        # The file is closed again: workers open it in their own process.
        with open_hdf5(path) as file:
            self.times = dataset(file, "davis/left/flow_dist_ts", path, shape=(None,), kinds="f")[()]
            self._flow(file)

    def _flow(self, file: Hdf5File) -> Data:
        return dataset(file, "davis/left/flow_dist", self.path, shape=(len(self.times), 2, HEIGHT, WIDTH), kinds="f")

    def field(self, k: int) -> Flow:
        """Return field k, (H, W, 2) float32 px. The file is open only meanwhile: handles do not survive a fork."""
        with open_hdf5(self.path) as file:
            return np.moveaxis(self._flow(file)[k].astype(np.float32), 0, -1)


class MvsecSource:
    """Samples of ``<seq>_data.hdf5`` + ``<seq>_gt_flow_dist.npz`` or ``<seq>_gt.hdf5`` files at or below ``root``.

    Sample i of a sequence: events between images i - dt … i (old) and i … i + dt (new); ground truth over the same
    time. ``mask``: pixels with an event in the new window, inside the 256x256 centre crop, above the hood outdoors.
    Times: µs since the sequence's first image.

    protocol : of :data:`PROTOCOLS`; at "flow" the windows of a sample are between time stamps i - 1, i, i + 1 of the
    flow.   frames : ranges [first, end) of images or flow fields to score, in place of the protocol's.   dense : score
    pixels without events, too.
    Raises AssetError: no sequence, none with a sample, or one without the frames that the protocol scores.
    EventDataError: bad dt.
    ConfigError: unknown protocol."""

    has_backward = False

    def __init__(
        self,
        root: Path,
        dt: int = 1,
        protocol: str = "all",
        frames: Sequence[tuple[int, int]] = (),
        dense: bool = False,
    ):
        if dt not in (1, 4):
            raise EventDataError("MVSEC interval", where="dt", value=dt, accepted="1 or 4")
        if protocol not in PROTOCOLS:
            raise ConfigError("unknown choice", where="protocol", value=protocol, accepted=", ".join(PROTOCOLS))
        self.protocol = PROTOCOLS[protocol]
        if self.protocol.at == "flow" and dt != 1:
            raise ConfigError(f"{protocol} has samples at 20 Hz", where="dt", value=dt, accepted="1")
        files = [root] if root.is_file() else sorted(below(root, "*_data.hdf5"))
        if not files:
            raise AssetError("no *_data.hdf5", where=str(root))
        self.dt, self.dense, self._index = dt, dense, []
        for path in files:
            s = _MvsecSequence(path)
            stamps = self._stamps(s)
            # Flow must cover [stamp i, stamp i + dt], and events [stamp i - dt, stamp i].
            i0, i1 = np.searchsorted(stamps, (s.flow_us[0], s.flow_us[-1]))
            end = i1 + 1 if self.protocol.at == "flow" else i1  # the last stamp is the end of a sample
            all_frames = range(max(int(i0), dt), min(int(end), len(stamps)) - dt)
            ranges = tuple(frames) or self.protocol.frames.get(s.name)
            scored = [i for i in all_frames if ranges is None or any(a <= i < b for a, b in ranges)]
            if not scored and ranges is not None:
                raise AssetError(
                    f"has no frame that {'--frames' if frames else protocol} scores",
                    where=str(path),
                    value=f"{all_frames.start} to {all_frames.stop - 1}",
                    accepted=" and ".join(f"{a} to {b - 1}" for a, b in ranges),
                )
            self._index += [(s, i) for i in scored]
        if not self._index:
            raise AssetError(
                "no image whose windows the ground truth covers", where=str(root), accepted="flow at the images' times"
            )

    def _stamps(self, s: _MvsecSequence) -> Times:
        return s.image_us if self.protocol.at == "images" else s.flow_us

    def __len__(self) -> int:
        return len(self._index)

    def sequence_names(self) -> list[str]:
        """Return the name of each sample's sequence."""
        return [sequence.name for sequence, _ in self._index]

    def __getitem__(self, index: int) -> RawSample:
        s, i = self._index[index]
        t_old, t, t_new = (int(self._stamps(s)[j]) for j in (i - self.dt, i, i + self.dt))
        old, new = s.window(t_old, t), s.window(t, t_new)
        flow, valid = s.flow_between(t, t_new, self.protocol.truth)
        mask = np.full((HEIGHT, WIDTH), self.dense)
        mask[new.y, new.x] = True
        inside = np.zeros_like(mask)
        top, left = (HEIGHT - CROP) // 2, (WIDTH - CROP) // 2
        inside[top : top + CROP, left : left + CROP] = True
        if "outdoor" in s.name:
            inside[self.protocol.hood :] = False
        return RawSample(
            old, new, HEIGHT, WIDTH, f"{s.name}/{i:06d}", s.name, flow=flow, valid=valid, mask=mask & inside
        )


class _MvsecSequence:
    def __init__(self, path: Path):
        self.path, self.name = path, path.name.removesuffix("_data.hdf5")
        with open_hdf5(path) as file:
            self._count = len(_table(file, path))
            stamps = dataset(file, "davis/left/image_raw_ts", path, shape=(None,), kinds="f")[()]
            self._inds = dataset(file, "davis/left/image_raw_event_inds", path, shape=(len(stamps),), kinds="iuf")[
                ()
            ].astype(np.int64)
        if not len(stamps):
            raise AssetError("has no images, so samples have no times", where=str(path))
        flow, other = path.with_name(f"{self.name}_gt_flow_dist.npz"), path.with_name(f"{self.name}_gt.hdf5")
        if not flow.is_file() and not other.is_file():
            raise AssetError(
                "no such file", where=str(flow), accepted=f"ground truth beside the events, this or {other.name}"
            )
        self._truth = NpzTruth(flow) if flow.is_file() else Hdf5Truth(other)
        self.t0_s = float(stamps[0])
        self.image_us = _stamps(stamps - self.t0_s, f"{path}: 'davis/left/image_raw_ts'")
        self.flow_us = _stamps(self._truth.times - self.t0_s, f"{self._truth.path}: its time stamps")
        self._opened: Recent[int, tuple[Hdf5File, Data]] = Recent(1)
        """By process: HDF5 handles do not survive a fork."""
        self._rows: Recent[int, Flow] = Recent(9)

    def _open(self) -> tuple[Hdf5File, Data]:
        file = open_hdf5(self.path)
        return file, _table(file, self.path)

    def window(self, t0: int, t1: int) -> Window:
        """Return the events of [t0, t1) µs. The event indices of the images are hints; times decide."""
        _, table = self._opened.of(os.getpid(), self._open)
        images = np.searchsorted(self.image_us, t0, side="right") - 1, np.searchsorted(self.image_us, t1)
        low, high = (int(np.clip(self._inds[min(max(k, 0), len(self._inds) - 1)], 0, self._count)) for k in images)
        margin, where = 4096, str(self.path)
        while True:
            i, j = max(low - margin, 0), min(high + margin, self._count)
            rows = table[i : max(i, j)]
            t = microseconds(rows[:, 2] - self.t0_s, where, i)
            enough = len(t) and (i == 0 or t[0] < t0) and (j == self._count or t[-1] >= t1)
            if enough or (i == 0 and j == self._count):
                break
            margin *= 4
        # Contiguous columns, because each is read several times.
        x, y, seconds, p = np.ascontiguousarray(rows.T)
        events = events_of(x, y, microseconds(seconds - self.t0_s, where, i), p, where, i, signed=True)
        check_events(events, where, i, height=HEIGHT, width=WIDTH)
        return Window.of(events, t0, t1)

    def flow_between(self, t0: int, t1: int, truth: str = "propagated") -> tuple[Flow, Mask]:
        """Return flow (H, W, 2) float32 and valid over [t0, t1] µs; see :func:`propagate`. truth : of
        :data:`TRUTHS`."""
        k = int(np.clip(np.searchsorted(self.flow_us, t0, side="right") - 1, 0, len(self.flow_us) - 2))
        interval = int(self.flow_us[k + 1] - self.flow_us[k])
        if truth == "scaled" and t1 - t0 < interval:
            return propagate([(self._field(k), (t1 - t0) / interval)])
        pieces = []
        while k < len(self.flow_us) - 1 and self.flow_us[k] < t1:
            a, b = int(self.flow_us[k]), int(self.flow_us[k + 1])
            pieces.append((self._field(k), (min(b, t1) - max(a, t0)) / (b - a)))
            k += 1
        return propagate(pieces)

    def _field(self, k: int) -> Flow:
        return self._rows.of(k, lambda: self._truth.field(k))


def _table(file: Group, path: Path) -> Data:
    """Return the (N, 4) float64 data set of events: x, y, t[s], ±1. Raises AssetError."""
    return dataset(file, MVSEC_EVENTS[0], path, shape=(None, 4), kinds="f")


def _stamps(seconds: Numbers, where: str) -> Times:
    """Return times as int64 µs. Raises AssetError: not a list of increasing times."""
    if seconds.ndim != 1 or len(seconds) < 2:
        raise AssetError("not a list of times", where=where, value=seconds.shape, accepted="(N,) with N >= 2")
    t = microseconds(seconds, where)
    if (back := np.flatnonzero(t[1:] <= t[:-1])).size:
        raise AssetError(
            f"time {int(back[0]) + 1} is not after the previous one",
            where=where,
            value=tuple(seconds[back[0] : back[0] + 2].tolist()),
        )
    return t


def propagate(pieces: list[tuple[Flow, float]]) -> tuple[Flow, Mask]:
    """Return the displacement of every pixel through successive flow fields, each over a fraction of its interval.

    pieces : (flow (H, W, 2) px over the whole interval of the field, fraction in (0, 1]); (0, 0) is invalid. A field is
    read at the pixel nearest to the position reached. Returns flow (H, W, 2) float32 and valid (H, W): False if a piece
    was invalid or NaN, or the point left the image before the last piece."""
    height, width = pieces[0][0].shape[:2]
    start = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    at, valid = start.copy(), np.ones((height, width), bool)
    for flow, fraction in pieces:
        x, y = (np.rint(at[..., c]).astype(np.int64) for c in (0, 1))
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        step = flow[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64)
        valid &= inside & np.isfinite(step).all(-1) & (step != 0).any(-1)
        at = np.where(valid[..., None], at + step * fraction, at)
    return np.where(valid[..., None], at - start, 0).astype(np.float32), valid
