"""Whether frames of a folder are near enough to each other to be interpolated: every pair of them measured, and
compared with the limits of ``frames.qualify``.

The measures are those of :mod:`blinkgl.recordings.artefacts`. What a folder does not bring (a flow, the flow back) is
left out, and said.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.config.frames import FramesConfig, QualifyConfig
from blinkgl.errors import AssetError, EventDataError
from blinkgl.recordings import artefacts
from blinkgl.recordings.simulation import Decoder
from blinkgl.sequence.folders import (
    backward_files,
    flow_files,
    read_flow_of,
    read_frame,
    read_mask_of,
    used_images,
)
from blinkgl.timeline.interpolate import DenseFlow, halfway

MEASURES = {
    "displacement": "things move too far",
    "hidden": "too many pixels are hidden in the second",
    "uncovered": "too many pixels of the second were not in the first",
    "residual": "the given flow does not explain how the light changes",
    "thin": "thin things move on their own",
    "contradicted": "the interpolation's flows there and back contradict each other",
    "astray": "the interpolation does not follow the given flow",
    "fine": "the texture is too fine to be moved by parts of a pixel",
    "left_out": "a frame interpolated from those beside it is not that frame",
}
"""Keys of ``frames.qualify``, in the order of tables, and what is said of too much of each."""


@dataclass(frozen=True)
class Pair:
    """Frames ``number`` and ``number + 1`` of those used. values : measure -> number; those that could be had."""

    number: int
    first: str
    second: str
    values: dict[str, float]


@dataclass(frozen=True)
class Excess:
    """A measure of a pair that is beyond its limit."""

    pair: Pair
    measure: str
    value: float
    limit: float


@dataclass(frozen=True)
class Verdict:
    """What was measured of a folder. absent : measure -> why it could not be had."""

    folder: Path
    limits: QualifyConfig
    pairs: tuple[Pair, ...]
    absent: dict[str, str]

    @property
    def excesses(self) -> list[Excess]:
        """Every measure beyond its limit, pair by pair."""
        limits = {name: getattr(self.limits, name) for name in MEASURES}
        return [
            Excess(pair, name, pair.values[name], limit)
            for pair in self.pairs
            for name, limit in limits.items()
            if limit is not None and pair.values.get(name, 0.0) > limit
        ]

    @property
    def refused(self) -> int:
        """Pairs with a measure beyond its limit."""
        return len({excess.pair.number for excess in self.excesses})

    @property
    def qualifies(self) -> bool:
        return self.refused <= self.limits.tolerated * len(self.pairs)

    @property
    def worst(self) -> dict[str, float]:
        """Largest value of each measure over the pairs."""
        return {
            name: max(pair.values[name] for pair in self.pairs if name in pair.values)
            for name in MEASURES
            if any(name in pair.values for pair in self.pairs)
        }

    @property
    def farthest(self) -> Excess | None:
        """The excess that is largest for its limit; None where there is none."""
        return max(self.excesses, key=lambda excess: _times(excess.value, excess.limit), default=None)

    def refusal(self) -> AssetError | None:
        """The error that says why the folder does not qualify; None: it does."""
        excess = self.farthest
        if self.qualifies or excess is None:
            return None
        more = f"; beyond a limit: {self.refused} of {len(self.pairs)} pairs" if self.refused > 1 else ""
        return AssetError(
            f"cannot be interpolated: {MEASURES[excess.measure]}: {excess.measure} "
            f"{shown(excess.measure, excess.value)}{more}",
            where=f"{self.folder}: {excess.pair.first} to {excess.pair.second}",
            accepted=f"at most {shown(excess.measure, excess.limit)} (frames.qualify.{excess.measure}), or "
            "frames.qualify: null to convert them all the same",
        )

    def facts(self) -> dict[str, Any]:
        """Plain values for a manifest: the largest of each measure over the pairs, and the limits."""
        return {
            "pairs": len(self.pairs),
            "beyond_limits": self.refused,
            "largest": {name: float(f"{value:.4g}") for name, value in self.worst.items()},
            "limits": self.limits.model_dump(),
        }


def _times(value: float, limit: float) -> float:
    return value / limit if limit else np.inf if value else 0.0


def shown(measure: str, value: float) -> str:
    """ "12.3 px", "4.1 %", "0.08"."""
    if measure == "displacement":
        return f"{value:.3g} px"
    return f"{value:.3g}" if measure == "residual" else f"{100 * value:.3g} %"


def verdict(frames: FramesConfig, folder: Path) -> Verdict:
    """Every pair of the frames of ``folder`` measured; limits those of ``frames``, or the standard ones where it has
    none. Holds three frames at a time.

    Raises AssetError (unreadable, too few frames, flow files that are missing, of another size or without a single
    valid vector), EventDataError (a changed size, NaN or negative light), ConfigError (too long)."""
    files = used_images(frames, folder)
    flows, masks = flow_files(folder, frames, files)
    backs = backward_files(folder, frames, files)
    light = _Light(frames, files)
    given = partial(_given, light.size, flows, masks, backs) if flows else None
    measured = enumerate(measure(light, frames.interpolate, given))
    pairs = tuple(Pair(k, files[k].name, files[k + 1].name, values) for k, values in measured)
    absent = _absent(frames.interpolate == "motion" and _dense_fits(light.size), bool(flows), bool(backs or masks))
    return Verdict(folder, frames.qualify or QualifyConfig(), pairs, absent)


Given = tuple[np.ndarray, np.ndarray, np.ndarray | None]
"""flow (H, W, 2) px, valid (H, W) bool, and (H, W) bool of what the second frame does not show; None: not known."""


def measure(
    light: Sequence[np.ndarray] | _Light, interpolate: str, given: Callable[[int], Given] | None = None
) -> Iterator[dict[str, float]]:
    """The measures of every pair of frames, by name; those that can be had.

    light : frames, (H, W) float32 linear light each, two or more; asked for in their order.   given : the flow of the
    k-th pair; None: there is none. Raises ValueError: a flow without a valid vector, or of another size."""
    dense = DenseFlow() if interpolate == "motion" and _dense_fits(light[0].shape) else None
    guess = _halfway(dense)
    tried: float | None = None  # of the frame that the pair begins with
    everywhere = np.ones(light[0].shape, bool)
    for k in range(len(light) - 1):
        a, b = light[k], light[k + 1]
        values = {"fine": artefacts.fine(a)}
        own = None
        if dense is not None:
            own, own_back = dense(dense.codes(a), dense.codes(b))
            values["contradicted"] = float(artefacts.hidden(own, everywhere, own_back, everywhere).mean())
        if given is not None:
            flow, valid, gone = given(k)
            values |= artefacts.of_given_flow(a, b, flow, valid, gone=gone, own=own)
        elif own is not None:
            values["displacement"] = artefacts.displacement(own, everywhere)
        following = None if k + 2 == len(light) else artefacts.left_out(a, b, light[k + 2], guess)
        beside = [value for value in (tried, following) if value is not None]
        if beside:
            values["left_out"] = float(np.mean(beside))
        tried = following
        yield {name: values[name] for name in MEASURES if name in values}


def _dense_fits(size: tuple[int, ...]) -> bool:
    return min(size) >= DenseFlow.LEAST


def _absent(dense: bool, flow: bool, hidden: bool) -> dict[str, str]:
    """measure -> why it cannot be had."""
    why = {} if dense else dict.fromkeys(("contradicted", "astray"), "the interpolation follows no flow")
    if not flow:
        needed = ("hidden", "uncovered", "residual", "thin", "astray" if dense else "displacement")
        return {**why, **dict.fromkeys(needed, "no flow")}
    return why if hidden else {**why, "hidden": "neither backward flow nor masks"}


def _given(size: tuple[int, int], flows: list[Path], masks: list[Path], backs: list[Path], k: int) -> Given:
    flow, valid = read_flow_of(flows[k], size)
    if not valid.any():
        raise AssetError("no valid vector in it", where=str(flows[k]), accepted="finite numbers, px")
    if backs:
        return flow, valid, artefacts.hidden(flow, valid, *read_flow_of(backs[k], size))
    return flow, valid, read_mask_of(masks[k], size) & valid if masks else None


def _halfway(dense: DenseFlow | None) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """How the interpolation guesses a frame from those beside it. Without dense flow: the mean of ln(light), which is
    what an emulator does by itself; the cubic differs from it by what its outer neighbours say."""
    if dense is not None:
        return lambda a, b: halfway(a, b, *dense(dense.codes(a), dense.codes(b)))
    eps = artefacts.EPS
    return lambda a, b: np.maximum(np.sqrt((a + eps) * (b + eps)) - eps, np.float32(0))


class _Light:
    """Frames as linear light, the last three kept. size : (H, W) of the first."""

    def __init__(self, frames: FramesConfig, files: list[Path]):
        self._files, self._decode = files, Decoder(frames.gamma)
        self._kept: dict[int, np.ndarray] = {}
        self._shape: tuple[int, ...] | None = None
        height, width = self[0].shape
        self.size = height, width

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, k: int) -> np.ndarray:
        if k not in self._kept:
            frame, name = read_frame(self._files[k]), str(self._files[k])
            self._shape = self._shape or frame.shape
            if frame.shape != self._shape:
                raise EventDataError(
                    "frame size changed", where=name, value=frame.shape, accepted=f"{self._shape} as the first frame"
                )
            self._kept[k] = self._decode(frame, name)
            self._kept.pop(k - 3, None)
        return self._kept[k]
