"""AEDAT 2.0 (jAER) of DAVIS cameras: events, frames and IMU samples, decoded by numba kernels; and events of a DVS128.

A header of lines that begin with ``#``; then records of eight bytes, big-endian: an address and a time in µs, 32 bits
each. Addresses (jAER's ``DavisChip`` and iniVation's page "AEDAT file formats"):

    bit 31 = 0: event         30..22 y   21..12 x   11 polarity   10 = 1: pin of the camera, no pixel
    bit 31 = 1: frame sample  30..22 y   21..12 x   11..10: 0 reset read, 1 signal read   9..0 ADC sample
                IMU value     30..28 which: acceleration x y z, temperature, rate x y z   27..12 value   11..10: 3

y counts from the bottom, and x of events (alone) from the right. A time is counted modulo 2^32 (71.6 minutes).
Of a DVS128: bit 15 = 1: no pixel   14..8 y   7..1 x, from the right   0 polarity, inverted.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.columns import CameraFrame, G, ImuSamples
from blinkgl.io.fixed_records import read_records
from blinkgl.io.reading import AS_FILE, Damage, EventReading
from blinkgl.io.records import input_errors
from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

MAGIC = b"#!AER-DAT"
SIZES = {
    "DAVIS128": (128, 128),
    "DAVIS208": (192, 208),
    "DAVIS240": (180, 240),
    "DAVIS346": (260, 346),
    "DAVIS640": (480, 640),
    "DVS128": (128, 128),
    "Tmpdiff128": (128, 128),
}
"""(height, width) of chips; further letters of their names do not matter here."""
_DVS128 = ("DVS128", "Tmpdiff128")
_UNUSED = 0x3FF
"""Bits that no event of a DAVIS sets, and most of a DVS128 do."""
# A larger header, in bytes, is damaged.
_MAX_LINE, _MAX_HEADER = 1 << 16, 1 << 26
# Big-endian records of 8 bytes, see the module.
_RECORD = np.dtype([("address", ">u4"), ("t", ">u4")])
# Values of an IMU sample: three accelerations, the temperature, three rates.
_VALUES = 7
_FULL_SCALE = 1 << 15
_DEFAULT_RATE, _DEFAULT_ACCELERATION = 1000.0, 8.0
"""Full scales, degrees/s and g, that jAER uses where the header gives none."""
# Kinds of records. Kind k has its last time in state[1 + k] of _unwrap.
_DVS, _PIN, _APS, _IMU = range(4)


class Aedat2Reader:
    """A recording of a DAVIS camera; times are the file's own µs, unwrapped. height, width : px, by the chip's name, or
    as declared where the header names none (v2e's files).

    Raises AssetError: another magic or version, an unknown chip, a header without an end; while reading, naming the
    byte: stray bytes at the end (truncated), an address outside the sensor, decreasing times."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path, self._keep = Path(path), reading.keep
        self._header, self._start = _read_header(self.path)
        self.notes: list[str] = []
        # jAER names the chip by its Java class, whose last part is such as DAVIS346B.
        chip = re.search(r"^#\s*AEChip:\s*(\S+)", self._header, re.M)
        name = chip.group(1).rpartition(".")[2] if chip else None
        # A digit behind the name would belong to the number of another chip.
        known = next((known for known in SIZES if name and re.match(rf"{known}(?!\d)", name, re.I)), None)
        if chip is None:
            known = self._unnamed(reading)
        size = SIZES[known] if known else None if chip else reading.size
        if size is None:
            raise AssetError(
                "a camera with unknown addresses" if chip else "no camera named in the header ('# AEChip: …')",
                where=str(path),
                value=name,
                accepted=", ".join(SIZES) + ("" if chip else "; of a DAVIS or v2e --size WIDTHxHEIGHT says it, too"),
            )
        self._single = known in _DVS128
        self.height, self.width = size
        if self._single:
            self.notes.append("y as in the file, which jAER shows from the bottom (--origin bottom turns it)")

    def _unnamed(self, reading: EventReading) -> str | None:
        """Return "DVS128" where only its addresses explain all records of a file whose header names no camera. Raises
        AssetError: a size is declared, and no DAVIS has these addresses, either."""
        largest = bits = 0
        for _, raw in read_records(self.path, self._start, _RECORD, 1 << 17):
            largest = max(largest, int(raw["address"].max()))
            # The low bits of frame samples and IMU values are in use.
            events = raw["address"][(raw["address"] >> 31 == 0) & (raw["address"] >> 10 & 1 == 0)]
            bits |= int(np.bitwise_or.reduce(events)) & _UNUSED if len(events) else 0
        if bits and largest < 1 << 16 and reading.size in (None, SIZES["DVS128"]):
            self.notes.append("all addresses are a DVS128's, and no DAVIS's: read as such")
            return "DVS128"
        if bits:
            raise AssetError(
                "addresses that no DAVIS has, and no camera named in the header ('# AEChip: …')",
                where=str(self.path),
                value=f"bits 0x{bits:x}",
                accepted=", ".join(SIZES),
            )
        return None

    def chunks(self, records: int = 1 << 17) -> Iterator[Events]:
        """Yield all events, decoded from ``records`` records at a time."""
        for _, address, t in self._kind(_DVS, records):
            if self._single:
                x, y, on = self.width - 1 - (address >> 1 & 0x7F), address >> 8 & 0x7F, ~address & 1
            else:
                # The file counts x of events from the right and y from the bottom.
                x = self.width - 1 - (address >> 12 & 0x3FF)
                y = self.height - 1 - (address >> 22 & 0x1FF)
                on = address >> 11 & 1
            # An address outside is negative here, and beyond every sensor as uint16.
            yield Events(x.astype(np.uint16), y.astype(np.uint16), t, on.astype(np.uint8))

    def frames(self, records: int = 1 << 17) -> Iterator[CameraFrame]:
        """Yield frames in their order: reset minus signal sample, (H, W) uint16 of 0 … 1023, 0 where it would be
        negative.

        Frames of a part of the sensor (a region of interest) are 0 elsewhere. The exposure of a global shutter is from
        the last reset read to the first signal read; of a rolling one, that of the row read first."""
        assembler = _Frames(self.height, self.width)
        for _, address, t in self._kind(_APS, records):
            yield from assembler.add(address, t)
        yield from assembler.end()

    def imu(self) -> ImuSamples:
        """Return all complete samples. Scales are the header's (``ImuGyroScale``, ``ImuAccelScale``), or jAER's usual
        ones."""
        parts = [(address, t) for _, address, t in self._kind(_IMU)]
        address = np.concatenate([a for a, _ in parts]) if parts else np.empty(0, np.int64)
        t = np.concatenate([t for _, t in parts]) if parts else np.empty(0, np.int64)
        # The 16-bit values are signed. ``which`` is 0 for the first value of a sample.
        which, value = address >> 28 & 7, (address >> 12 & 0xFFFF).astype(np.uint16).view(np.int16).astype(np.float64)
        # A sample is seven values in their order; a file may begin or end within one.
        begins = np.flatnonzero(which == 0)
        begins = begins[begins + _VALUES <= len(which)]
        rows = begins[:, None] + np.arange(_VALUES)
        rows = rows[(which[rows] == np.arange(_VALUES)).all(1)]
        values = value[rows] if len(rows) else np.empty((0, _VALUES))
        # A signed 16-bit value of 2^15 stands for the full scale.
        rate = _scale(self._header, "ImuGyroScale", "GyroFullScaleDegPerSec", _DEFAULT_RATE) / _FULL_SCALE
        pull = _scale(self._header, "ImuAccelScale", "ImuAccelScaleG", _DEFAULT_ACCELERATION) / _FULL_SCALE
        return ImuSamples(
            t[rows[:, 0]] if len(rows) else np.empty(0, np.int64),
            values[:, :3] * (pull * G),
            np.radians(values[:, 4:] * rate),
            values[:, 3] / 340 + 35,  # InvenSense MPU-6150, the unit of these cameras
        )

    def _kind(self, kind: int, records: int = 1 << 17) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
        """Yield (index of the first record, addresses, times) of one kind of records; the others are checked, too, so
        that a damaged file is always refused."""
        # state: the last time, then the last time of each kind.
        state = np.full(5, -1, np.int64)
        last = lambda count: f"record {count - 1}, at byte {self._byte(count)}"
        for first, raw in read_records(self.path, self._start, _RECORD, records, last):
            # int64, so that shifts and differences cannot overflow.
            address, stamp = raw["address"].astype(np.int64), raw["t"].astype(np.int64)
            kinds = np.where(address >> 15, _PIN, _DVS) if self._single else _kinds(address)
            t = np.empty(len(raw), np.int64)
            keep = self._keep and kind == _DVS
            sides = (1 << 10, 1 << 10) if self._single else (self.height, self.width)  # a DVS128 has no others
            bad, why = _unwrap(address, kinds, stamp, state, *sides, keep, t)
            if bad >= 0:
                self._refuse(first + bad, int(address[bad]), int(stamp[bad]), why, state)
            chosen = kinds == kind
            if chosen.any():
                yield first, address[chosen], t[chosen]

    def _byte(self, record: int) -> int:
        return self._start + record * _RECORD.itemsize

    def _refuse(self, record: int, address: int, stamp: int, why: int, state: np.ndarray) -> None:
        at = f"record {record}, at byte {self._byte(record)}"
        if why == 1:
            place = (address >> 12 & 0x3FF, address >> 22 & 0x1FF)
            raise Damage(
                f"an address outside the sensor: {at}",
                where=str(self.path),
                value=f"x {place[0]}, y {place[1]} (address 0x{address:08x})",
                accepted=f"x < {self.width}, y < {self.height}",
            )
        raise Damage(
            f"times decrease: {at}",
            where=str(self.path),
            value=stamp,
            accepted=f"at least {int(state[0]) & 0xFFFFFFFF} µs, or a wrap of 32 bits",
        )


def _read_header(path: Path) -> tuple[str, int]:
    """Return the lines that begin with '#', and where they end. A record may also begin with that byte (y of 140 …
    143); but a line has no control characters, which its low bytes are, and newer files mark the end."""
    lines, size = [], 0
    with input_errors(path), open(path, "rb") as file:
        magic = file.read(len(MAGIC) + 3)
        if not magic.startswith(MAGIC):
            raise AssetError("not an AEDAT file: wrong magic", where=str(path), value=magic, accepted="#!AER-DAT2.0")
        if magic != MAGIC + b"2.0":
            version, accepted = magic[len(MAGIC) :].decode("latin-1"), "2.0 (4.0 is .aedat4)"
            raise AssetError("another version of AEDAT", where=str(path), value=version, accepted=accepted)
        start = file.seek(0)
        while (line := file.readline(_MAX_LINE)).startswith(b"#"):
            cut = not line.endswith(b"\n") and len(line) < _MAX_LINE
            if cut or any(c < 32 and c not in b"\t\r\n" for c in line):
                break
            size += len(line)
            if len(line) == _MAX_LINE or size > _MAX_HEADER:
                raise AssetError(f"a header without an end, at byte {start}", where=str(path))
            lines.append(line.decode("utf-8", "replace").rstrip())
            start = file.tell()
            if re.match(r"#\s*End Of ASCII Header", lines[-1], re.I):
                break
    return "\n".join(lines), start


def _scale(header: str, key: str, prefix: str, usual: float) -> float:
    stated = re.search(rf'key="{key}" value="{prefix}(\d{{1,9}})"', header)
    return float(stated.group(1)) if stated else usual


def _kinds(address: np.ndarray) -> np.ndarray:
    """Return _DVS, _PIN, _APS or _IMU for every address (int64); frame samples of the unused sub-type are _PIN."""
    # Bits 11 and 10 tell the kinds of records with and without bit 31 apart.
    low = address >> 10 & 3
    return np.where(
        address >> 31 == 0, np.where(low & 1, _PIN, _DVS), np.where(low == 3, _IMU, np.where(low == 2, _PIN, _APS))
    )


@kernel
def _unwrap(address, kinds, stamp, state, height, width, keep, t):
    """Fill times, int64 µs, and return (index of the first bad record, or -1; 1: outside the sensor, 2: backwards).
    keep : neither is bad.

    Records of one kind are in order of time; of different kinds they may be out of order by less than half of the range
    of 32 bits."""
    for i in range(len(address)):
        kind = kinds[i]
        # Only events and frame samples have coordinates.
        if kind == 0 or kind == 2:
            if not keep and ((address[i] >> 12 & 0x3FF) >= width or (address[i] >> 22 & 0x1FF) >= height):
                return i, 1
        # Unwrapping: the difference to the last time modulo 2^32, taken as a signed number.
        if state[0] < 0:
            now = stamp[i]
        else:
            step = (stamp[i] - state[0]) & 0xFFFFFFFF
            now = state[0] + (step if step < 0x80000000 else step - 0x100000000)
        # Within its own kind a record must not be earlier than the one before.
        if (now < state[1 + kind] and not keep) or now < 0:
            # For the message: the time that this record must not precede.
            state[0] = max(state[1 + kind], 0)
            return i, 2
        t[i] = now
        state[0] = max(now, state[0])
        state[1 + kind] = now
    return -1, 0


class _Frames:
    """Assembles frames from frame samples, in their order. Those without all of their samples are left out."""

    def __init__(self, height: int, width: int):
        self._shape = height, width
        self._clear()

    def _clear(self) -> None:
        self._reset, self._signal = (np.full(self._shape, -1, np.int32) for _ in range(2))
        self._times = np.array([-1, -1, -1], np.int64)  # first reset, last reset, first signal

    def add(self, address: np.ndarray, t: np.ndarray) -> Iterator[CameraFrame]:
        begin = 0
        while begin < len(address):
            begin = _assemble(address, t, begin, self._reset, self._signal, self._times)
            # The next sample belongs to the following frame.
            if begin < len(address):
                yield from self.end()

    def end(self) -> Iterator[CameraFrame]:
        """Yield the frame so far, if it is one."""
        # A frame is complete where each pixel that was reset has also been read, in a rectangle.
        read, there = self._signal >= 0, self._reset >= 0
        if read.any() and np.array_equal(read, there) and _rectangular(read):
            image = np.where(read, np.maximum(self._reset - self._signal, 0), 0).astype(np.uint16)
            first, last, signal = self._times.tolist()
            # A global shutter resets all rows before the first is read; a rolling one does not.
            begin = last if last <= signal else first
            # Row 0 of the samples is the bottom of the image.
            yield CameraFrame(image[::-1].copy(), begin, max(signal, begin))
        self._clear()


def _rectangular(mask: np.ndarray) -> bool:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return bool(mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].all())


@kernel
def _assemble(address, t, begin, reset, signal, times):
    """Return the index of the next frame's first sample: a reset or another read of a pixel that was read."""
    for i in range(begin, len(address)):
        # Bit fields of a frame sample: x, y, and the 10 bits of the ADC.
        x, y, sample = address[i] >> 12 & 0x3FF, address[i] >> 22 & 0x1FF, address[i] & 0x3FF
        # Bit 10 is 1 for a signal read and 0 for a reset read.
        if address[i] >> 10 & 1:
            # A second read of a pixel belongs to the next frame.
            if signal[y, x] >= 0:
                return i
            signal[y, x] = sample
            if times[2] < 0:
                times[2] = t[i]
        else:
            # So does a reset of a pixel that has been reset or read.
            if reset[y, x] >= 0 or signal[y, x] >= 0:
                return i
            reset[y, x] = sample
            if times[0] < 0:
                times[0] = t[i]
            times[1] = t[i]
    return len(address)
