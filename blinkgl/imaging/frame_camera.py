"""A frame camera: draws the instants of each exposure, adds their light, and reads it out.

    camera = FrameCamera(renderer, config.images, seed, (t0_ns, t1_ns))
    while camera.due_ns is not None:
        image = camera.take()                  # a CameraImage

It depends on a renderer but not on sequences or files; several may use one scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.config.images import NS_PER_US, ImagesConfig, exposure_starts
from blinkgl.imaging import lens as thin_lens
from blinkgl.imaging.exposure import Exposure, Setting, accumulate, factor, instants, next_setting
from blinkgl.imaging.sensor import encode, mosaic, readings
from blinkgl.machine.compiling import working_clock
from blinkgl.render.colour import LUMA
from blinkgl.render.moment import View
from blinkgl.types.trees import Tree

if TYPE_CHECKING:
    from blinkgl.render.renderer import Renderer

LENS_SPACING = 2.0
"""Spacing of lens samples of out-of-focus points, in ``max_px``: one pixel by default, because each sample is a pixel's
mean."""


@dataclass(frozen=True, eq=False)
class CameraImage:
    """An image of a frame camera.

    k : number, from 0.   start_ns, end_ns : from the first row's exposure to the end of the last one's.
    exposure_ns : of each row.   row_ns : between the starts of two rows.   gain : a factor.
    instants : number of instants averaged.   step_px : largest motion between two.
    pictures : name -> codes, (H, W, 3) RGB or (H, W) of one colour per pixel, uint8 for 8 bits, else uint16: "images",
    the camera's output, and those of ``images.also``.   sensor : name of the camera; "" of a single one."""

    k: int
    start_ns: int
    end_ns: int
    exposure_ns: int
    row_ns: float
    gain: float
    instants: int
    step_px: float
    pictures: Mapping[str, np.ndarray]
    sensor: str = ""

    @property
    def t_ns(self) -> int:
        """Return its time: the end of the last row's exposure."""
        return self.end_ns

    @property
    def middle_ns(self) -> int:
        """Return the middle of the exposure, of the middle row where they differ."""
        return (self.start_ns + self.end_ns) // 2

    @property
    def image(self) -> np.ndarray:
        """Return the picture that the camera writes, with all of its effects."""
        return self.pictures["images"]


class FrameCamera:
    """Takes images with a given renderer.

    config : ``images:``.   seed : 64-bit, of its noise.   span_ns : first and last time of the sequence.
    due_ns : time of the next image; None: there are no more.   taken : images so far.   drawn : instants so far.
    exposed_ns : start, middle and end of each exposure so far.
    largest_step_px : of all images, see :class:`CameraImage`.   seconds : wall time besides the drawing."""

    def __init__(self, renderer: Renderer, config: ImagesConfig, seed: int, span_ns: tuple[int, int]):
        camera = renderer.scene.camera
        self.renderer, self.config, self._seed = renderer, config, np.uint64(seed)
        self._starts = exposure_starts(config, *span_ns, camera.height)
        self._first = Setting(round(NS_PER_US * config.exposure_us), factor(config.gain_db))
        self._vignette = thin_lens.vignette(camera, config.vignetting)[..., None] if config.vignetting else None
        self.rewind()

    def rewind(self) -> None:
        """Return to before the first image."""
        self._setting = self._first
        self.taken, self.drawn, self.largest_step_px, self.seconds = 0, 0, 0.0, 0.0
        self.exposed_ns: list[tuple[int, int, int]] = []

    def __len__(self) -> int:
        """Return the total number of images."""
        return len(self._starts)

    @property
    def due_ns(self) -> int | None:
        # The length of the exposure is known only now, since the images before it decide it.
        return None if self.taken == len(self._starts) else self._exposure().end_ns

    def take(self) -> CameraImage:
        """Return the next image. Raises GLError."""
        started, drawing = working_clock(), self._drawing_s
        image = self._take()
        # Without the time that the renderer has counted as its own.
        self.seconds += working_clock() - started - (self._drawing_s - drawing)
        return image

    @property
    def _drawing_s(self) -> float:
        return self.renderer.stats.render_s + self.renderer.stats.readback_s

    def _take(self) -> CameraImage:
        k, setting, exposure = self.taken, self._setting, self._exposure()
        light, count, step_px = self._light(exposure)
        clean = self._reading(light, setting)
        pictures = {"images": self._codes(self._noisy(light, setting, k) if self.config.noisy else clean)}
        if "sharp" in self.config.also:
            sharp = self._at(self.renderer.colour(exposure.middle_ns).read())
            pictures["sharp"] = self._codes(self._reading(sharp, setting))
        if "clean" in self.config.also:
            pictures["clean"] = self._codes(clean)
        self.taken, self.drawn = k + 1, self.drawn + count
        self.exposed_ns.append((exposure.start_ns, exposure.middle_ns, exposure.end_ns))
        self.largest_step_px = max(self.largest_step_px, step_px)
        # By the image without its noise, so that two seeds are exposed alike.
        if self.config.auto_exposure is not None and self.taken < len(self._starts):
            dt_s = (self._starts[k + 1] - self._starts[k]) * 1e-9
            self._setting = next_setting(self.config.auto_exposure, setting, _mean(clean), dt_s)
        return CameraImage(
            k=k,
            start_ns=exposure.start_ns,
            end_ns=exposure.end_ns,
            exposure_ns=exposure.exposure_ns,
            row_ns=exposure.row_ns,
            gain=setting.gain,
            instants=count,
            step_px=step_px,
            pictures=pictures,
        )

    def facts(self) -> Tree:
        """Return plain values for a manifest."""
        return {
            "images": self.taken,
            "pictures": list(self.config.pictures),
            "bits": self.config.bits,
            "instants": self.drawn,
            "largest_step_px": float(f"{self.largest_step_px:.4g}"),
        }

    # ---- light ---------------------------------------------------------------------------------------------------

    def _exposure(self) -> Exposure:
        return Exposure(
            self._starts[self.taken],
            self._setting.exposure_ns,
            NS_PER_US * self.config.row_us,
            self.renderer.height,
        )

    def _light(self, exposure: Exposure) -> tuple[np.ndarray, int, float]:
        """Return the mean over the exposure, (H, W, 3) float64, 1 being white; the number of instants; the largest
        motion between two of them, px."""
        config, draw = self.config, self.renderer
        speed, jumps = draw.motion.fastest(exposure.start_ns, exposure.end_ns, config.max_px)
        points = self._points_needed(exposure.middle_ns)
        changes = max((wave.per_second() for wave in draw.scene.waveforms.values()), default=0.0)
        # As many instants as motion, lens and changing light ask for, whichever needs most.
        count = instants(exposure, speed, config.max_px, points, config.max_instants, changes)
        # A jump has no speed by which a number could be chosen, so there are as many as are allowed.
        if jumps:
            count = config.max_instants
        lens = config.lens if points > 1 else None
        aperture = None if lens is None else thin_lens.points(count, lens.aperture)
        total = np.zeros((draw.height, draw.width, 3))
        cells, weights = exposure.cells(count)
        # Each instant stands for its part of the exposure; changing lamps are integrated over it.
        for i, (begin_ns, t_ns, end_ns) in enumerate(cells):
            moment = draw.moment(t_ns)
            if draw.scene.waveforms:
                moment = moment.over(begin_ns, end_ns)
            if lens is not None and aperture is not None:
                seen = thin_lens.through(moment.view.camera, aperture[i], lens.focus)
                moment = moment.from_place(View.of(seen), thin_lens.at_point(moment.T_world_cam, aperture[i]))
            accumulate(total, draw.colour(moment).view(), weights[i])
        return self._at(total), count, speed * (exposure.end_ns - exposure.start_ns) * 1e-9 / count

    def _points_needed(self, t_ns: int) -> int:
        """Return the number of lens points for the discs of the depths in view; 1 where no disc exceeds a pixel."""
        lens = self.config.lens
        if lens is None:
            return 1
        depth = self.renderer.draw(self.renderer.geometry(("depth",)), t_ns).read("depth")
        # A depth of 0 stands for no surface, which is infinitely far.
        depth = np.where(depth > 0, depth, np.inf)
        largest = float(thin_lens.blur_px(lens, self.renderer.scene.camera, depth).max())
        return thin_lens.samples(largest, LENS_SPACING * self.config.max_px)

    def _at(self, radiance: np.ndarray) -> np.ndarray:
        """Return the light at the pixels, 1 being white."""
        light = np.asarray(radiance, np.float64) / self.config.white
        return light if self._vignette is None else light * self._vignette

    # ---- read-out ------------------------------------------------------------------------------------------------

    def _seen(self, light: np.ndarray, setting: Setting) -> tuple[np.ndarray, float, float]:
        """Return the light that passes the filters, the electrons of light 1, and the gain per electron."""
        light = light if self.config.bayer is None else mosaic(light, self.config.bayer)
        # of white, with the configured setting, full_well / gain
        electrons = self.config.full_well * setting.exposure_ns / self._first.product
        return light, electrons, setting.gain / self.config.full_well

    def _reading(self, light: np.ndarray, setting: Setting) -> np.ndarray:
        """Return the converter's input, 1 being the largest code, without noise."""
        light, electrons, gain = self._seen(light, setting)
        return np.minimum(light * electrons, self.config.full_well) * gain

    def _noisy(self, light: np.ndarray, setting: Setting, k: int) -> np.ndarray:
        """Return the converter's input with the noise of image ``k``."""
        config, (light, electrons, gain) = self.config, self._seen(light, setting)
        out, light = np.empty(light.shape), np.ascontiguousarray(light)
        readings(
            light.ravel(),
            electrons,
            gain,
            config.full_well,
            config.photon_noise,
            config.read_noise,
            self._seed,
            np.uint64(k),
            out.reshape(-1),
        )
        return out

    def _codes(self, reading: np.ndarray) -> np.ndarray:
        config = self.config
        # No light gives the black level, and full light the largest code.
        return encode(config.black + (1.0 - config.black) * reading, config.response, config.gamma, config.bits)


def _mean(reading: np.ndarray) -> float:
    """Return the mean of an output image, linear; for a colour image of its luminance."""
    seen = np.clip(reading, 0.0, 1.0)
    return float((seen @ LUMA).mean() if seen.ndim == 3 else seen.mean())
