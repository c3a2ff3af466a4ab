"""Pictures that a program makes from another picture, and their float64 references from the same one: silhouettes by
area (``edges.glsl``), and the picture of a lens (``gather.glsl``)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Protocol

import numpy as np
from scipy import ndimage

from blinkgl.camera import CameraModel
from blinkgl.camera.drawing import seen_through
from blinkgl.config.sequence import SequenceConfig
from blinkgl.render import lens
from blinkgl.render.antialiasing import Samples, samples_of
from blinkgl.render.casting import pixel_grid
from blinkgl.render.contours import Lines
from blinkgl.render.frames import Frame
from blinkgl.render.passes import Colour, Edged, Gather, Luminance, Pass
from blinkgl.render.passes.edged import SKY
from blinkgl.render.passes.shadow import ShadowMap
from blinkgl.scene.types import Scene


class _Renderer(Protocol):
    """What is used here of :class:`~blinkgl.tools.shader_debugger.session.DebugRenderer`, whose module needs this
    one."""

    scene: Scene
    maps: tuple[ShadowMap, ...]
    draw: Callable[[Pass, int], Frame]
    at_pixels: Callable[[np.ndarray], np.ndarray]


# ---------------------------------------------------------------------------------------------------------------------
# Slow reference of shaders/edges.glsl, a pixel at a time in float64; see there for what is done and why.
#
# picture, depths = frames of the pass that `edges` filters, read back pixels, crossings = Lines().in_pixels(moment,
# items, width, height) filtered(picture, depths, pixels, crossings, 1 / focal, what the program wrote)

GAP, COVER, SAME, NEARER, DIAGONAL, ALONG, SNAP = 3.0, 6.0, 0.25, 0.001, 0.25, 12, 1 / 128
SAMPLES, LINES, TANGLE, BORDER = 16, 12, 48, 0.4999
_AROUND = [(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]


UNDECIDED = 2.0**-22
"""Relative: float32 may decide a comparison of depths that are nearer to each other either way."""


def filtered(
    picture: np.ndarray,
    depths: np.ndarray,
    pixels: np.ndarray,
    crossings: np.ndarray,
    pixel: float,
    drawn: np.ndarray,
) -> np.ndarray:
    """Return (H, W) or (H, W, C) float64: the picture with its silhouettes and creases by area.

    picture : (H, W) or (H, W, C) float32.   depths : (H, W) float32, near / Z.   pixels, crossings : of
    :meth:`~blinkgl.render.contours.Lines.in_pixels`.   pixel : 1 / focal length, px.
    drawn : (H, W) or (H, W, C), the program's result. Where comparisons of depths are undecided the value is the one
    nearest to it."""
    if picture.ndim == 3:
        each = (filtered(picture[..., k], depths, pixels, crossings, pixel, drawn[..., k]) for k in range(3))
        return np.stack(list(each), axis=-1)
    out = picture.astype(np.float64)
    # Compared are the picture's depths with the lines'.
    exact, *others = (
        _Pixel(out.copy(), depths.astype(np.float64) * (1 + scale), pixel) for scale in (0.0, UNDECIDED, -UNDECIDED)
    )
    for x, y, first, end in pixels.tolist():
        # The others are computed only where the exact value differs from the written one.
        lines, written = crossings[first:end].astype(np.float64), float(drawn[y, x])
        value = exact.mean(x, y, lines)
        if abs(value - written) > 1e-5 * abs(written):
            value = min([value, *(of.mean(x, y, lines) for of in others)], key=lambda one: abs(one - written))
        out[y, x] = value
    return out


class _Line:
    """A line's part in a pixel. begin, end, room, left : as of a crossing (contours.py)."""

    def __init__(self, begin: float, end: float, room: float, left: np.ndarray):
        self.begin, self.end, self.room, self.left = begin, end, room, left
        self.way = np.array([left[1], -left[0]])
        self.ends = tuple(along * self.way - room * left for along in (begin, end))

    def share_and_turn(self) -> tuple[float, float]:
        """Return the area between the line and the square's boundary as seen from the centre, and the part of the
        boundary, in half sides: the shorter way round, unless the centre lies on the other side of the line."""
        p, q = self.ends
        turn = _around(*q) - _around(*p)
        turn -= 8 * np.rint(turn / 8)
        if (self.room > 0) != (turn > 0) and abs(turn) > 2:
            turn += 8 if self.room > 0 else -8
        return float(0.5 * (p[0] * q[1] - p[1] * q[0]) - turn / 8), float(turn)

    def cuts(self, a: np.ndarray, b: np.ndarray) -> bool:
        """Return whether the line, continued where it leaves the pixel, lies between two places."""
        off_a, off_b = self.left @ a + self.room, self.left @ b + self.room
        if not off_a * off_b < 0:
            return False
        meet = (self.way @ a * off_b - self.way @ b * off_a) / (off_b - off_a)
        low, high = (abs(place).max() > BORDER for place in self.ends)
        return bool((low or meet > self.begin) and (high or meet < self.end))


def _around(x: float, y: float) -> float:
    """Return where a ray from a pixel's centre leaves its square, along the boundary, in half sides: 8 all round."""
    if x == 0 and y == 0:
        return 0.0
    if abs(x) >= abs(y):
        return y / x + (0.0 if x > 0 else 4.0)
    return (2.0 if y > 0 else 6.0) - x / y


class _Pixel:
    """The content of one pixel and its neighbours."""

    def __init__(self, picture: np.ndarray, depths: np.ndarray, pixel: float):
        self.picture, self.depths, self.pixel = picture, depths, pixel

    def _inside(self, x: int, y: int) -> tuple[int, int]:
        height, width = self.picture.shape
        return min(max(x, 0), width - 1), min(max(y, 0), height - 1)

    def _light(self, x: int, y: int) -> float:
        x, y = self._inside(x, y)
        return float(self.picture[y, x])

    def _depth(self, x: int, y: int) -> float:
        x, y = self._inside(x, y)
        return float(self.depths[y, x])

    def mean(self, x: int, y: int, crossings: np.ndarray) -> float:
        plain, own = self._light(x, y), self._depth(x, y)
        # Of silhouettes, by whether the centre is on the surface in front: shares, their sizes, what is on the other
        # side.
        parts, sizes, others = np.zeros(2), np.zeros(2), np.zeros(2)
        creases, bent, towards = 0.0, 0.0, np.zeros(2)
        # What the samples look at.
        lines: list[_Line] = []
        for begin, end, room, depth, lx, ly, kind, further in crossings[:TANGLE].tolist():
            line = _Line(begin, end, room, np.array([lx, ly]))
            if len(lines) < LINES and own <= depth * (1 + COVER * self.pixel):
                lines.append(line)
            share, turn = line.share_and_turn()
            # A crease or a seam: both sides are on one surface, so only their shares are summed here.
            if kind > 0.5:
                seam = kind > 1.5
                if depth * (1 - (GAP * self.pixel if seam else SAME)) <= own <= depth * (1 + COVER * self.pixel):
                    creases += share
                    towards += share * line.left
                    bent += 0.0 if seam else abs(share)
                continue
            # A silhouette: its share moves light from the surface behind to the one in front.
            sides = self._sides(x, y, own, room, depth, line.left, further, kind < -0.5)
            if sides is None:
                continue
            front, back, inside = sides
            on_left = room > 0
            # A centre on the line itself belongs to the side that was drawn there.
            if abs(room) < SNAP and on_left != ((kind < -0.5) != inside):
                share += (turn - _turn(turn, not on_left)) / 8
            parts[int(inside)] += -share if inside else share
            sizes[int(inside)] += abs(share)
            others[int(inside)] += abs(share) * (back if inside else front)
        # Limit the sum to the whole.
        parts = np.clip(parts, 0, 1)
        parts /= max(parts.sum(), 1)
        result = plain
        for part, size, other in zip(parts, sizes, others, strict=True):
            result += part * (other / size - plain) if size > 0 else 0.0
        level = (SAME if bent > 0 else COVER * self.pixel) * own
        if towards.any() and (beyond := self._beyond(x, y, own, towards, level)) is not None:
            result += min(abs(creases), 1 - parts.sum()) * (beyond - plain)
        if len(lines) < 2:
            return result
        # What no centre shows is a surface between them: one of those in front.
        between = others[0] / sizes[0] if sizes[0] > 0 else None
        values = [v for k in range(SAMPLES) if (v := self._sample(x, y, k, lines, between)) is not None]
        if not values:
            return result
        mean, least, most = float(np.mean(values)), min(plain, *values), max(plain, *values)
        accuracy = (most - least) / SAMPLES
        return min(max(result, mean - accuracy, least), mean + accuracy, most)

    def _beyond(self, x: int, y: int, own: float, towards: np.ndarray, level: float) -> float | None:
        """Return the mean of the pixels on the other side of creases, in a direction, that are of the same surface:
        whose depth is within ``level`` of its ``own``. None: there is none."""
        towards = towards / np.hypot(*towards)
        total, beyond = 0.0, 0.0
        for dx, dy in _AROUND:
            weight = max((dx * towards[0] + dy * towards[1]) / max(dx * dx + dy * dy, 1) - 0.3, 0.0)
            if weight > 0 and abs(self._depth(x + dx, y + dy) - own) < level:
                total += weight
                beyond += weight * self._light(x + dx, y + dy)
        return beyond / total if total > 0 else None

    def _sample(self, x: int, y: int, k: int, lines: list[_Line], between: float | None) -> float | None:
        """Return the value at the k-th place in the pixel: the mean of the centres around that no line cuts off, by
        their distances; ``between`` if there is none."""
        at = (np.array([k, 5 * k % SAMPLES]) + 0.5) / SAMPLES - 0.5
        total, value = 0.0, 0.0
        for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
            to = np.sign(at).astype(int) * (right, down)
            there = x + int(to[0]), y + int(to[1])
            if there == self._inside(*there) and not any(line.cuts(to, at) for line in lines):
                weight = float(np.hypot(*(to - at)) ** -3)
                total += weight
                value += weight * self._light(*there)
        return value / total if total > 0 else between

    def _sides(
        self, x: int, y: int, own: float, room: float, depth: float, left: np.ndarray, further: float, back_again: bool
    ) -> tuple[float, float, bool] | None:
        """Return, for a silhouette's line, what is in front and behind, and whether the pixel's centre shows the first.
        None: the line is hidden, or one of them is unknown."""
        inwards = -left if back_again else left
        inside = back_again != (room > 0)
        behind, before = depth * (1 - GAP * self.pixel), depth * (1 + SAME)
        ax, ay = (int(np.rint(1.2 * c)) for c in inwards)
        there = (x, y) if inside else (x + ax, y + ay)
        front_depth = self._depth(*there)
        kept = self._inside(*there)
        within = self._depth(kept[0] + ax, kept[1] + ay)
        reached = front_depth + (front_depth - within) * min(max(abs(room) if inside else 1 - abs(room), 0.0), 1.0)
        horizon = front_depth > before and abs(reached - depth) < SAME * depth
        if horizon:
            before = 2 * front_depth
        fronts, in_front, backs, at_back = 0.0, 0.0, 0.0, 0.0
        for dx, dy in _AROUND:
            weight = 0.0 if dx == dy == 0 else DIAGONAL if dx and dy else 1.0
            seen, is_at = self._light(x + dx, y + dy), self._depth(x + dx, y + dy)
            if is_at < behind:
                backs += weight * seen
                at_back += weight or 1e-9
            elif is_at < before:
                fronts += weight * seen
                in_front += weight
        front = back = self._light(x, y)
        if at_back > 0:
            if own > (before if inside else depth * (1 + COVER * self.pixel)):
                return None
            inside = own >= behind
            known = inside or in_front > 0
            if inside:
                back = backs / at_back
            elif known:
                front = fronts / in_front
        else:
            other = (x - ax, y - ay)
            back_depth = self._depth(*other)
            if abs(room) < SNAP:
                front_depth = self._depth(x + ax, y + ay)
                inside = abs(own - front_depth) < abs(own - back_depth)
                there = (x, y) if inside else (x + ax, y + ay)
            if inside:
                front_depth = own
            else:
                other, back_depth = (x, y), own
            kept = self._inside(*other)
            beyond = self._depth(kept[0] - ax, kept[1] - ay)
            steps = min(max(1 - abs(room) if inside else abs(room), 0.0), 1.0)
            continued = back_depth + (back_depth - beyond) * steps
            if not min(continued, back_depth) < depth * (1 + NEARER):
                return None
            known = abs(front_depth - depth) < SAME * depth or horizon
            front, back = self._light(*there), self._light(*other)
        if not known:
            # Narrower than a pixel.
            front = self._along(x, y, depth, left, further)
        return None if front is None else (front, back, inside)

    def _along(self, x: int, y: int, depth: float, left: np.ndarray, further: float) -> float | None:
        """Return what is in front along a line, one pixel at a time, to both ends; None: nothing is."""
        onwards = np.array([left[1], -left[0]]) / max(abs(left))
        for k in range(2 * ALONG):
            steps = (k % 2 * 2 - 1) * (k // 2 + 2)
            at = (math.floor(x + 0.5 + steps * onwards[0]), math.floor(y + 0.5 + steps * onwards[1]))
            expected = depth + steps * further
            if abs(self._depth(*at) - expected) < SAME * expected:
                return self._light(*at)
        return None


def _turn(turn: float, on_left: bool) -> float:
    """Return a turn of the boundary, in eighths, for a centre on one side of the line."""
    least = turn - 8 * np.rint(turn / 8)
    return least + (8 if on_left else -8) if on_left != (least > 0) and abs(least) > 2 else least


EDGED = ("luminance_edges", "colour_edges")
LENSED = ("luminance_lens", "colour_lens")
FILTERED = EDGED + LENSED


def filtered_names(config: SequenceConfig, scene: Scene) -> tuple[str, ...]:
    """Return those of :data:`FILTERED` that a generation run draws: with ``edges2`` on a finer grid, of which this uses
    the image's own pixels."""
    # A lens's flat picture is filtered before the lens reads it, as without one.
    drawn = (config.render.antialiasing, config.render.image_antialiasing)
    edged = tuple(name for name, kind in zip(EDGED, drawn, strict=True) if samples_of(kind).edges)
    return edged + (() if places_of(scene.camera) is None else LENSED)


@lru_cache(maxsize=8)
def places_of(camera: CameraModel) -> np.ndarray | None:
    """Return (H, W, 2): column and row of the pixel of the flat picture that each pixel of a lens reads; None if the
    camera's own picture is drawn."""
    flat = seen_through(camera)
    if flat is camera:
        return None
    # From float32 places, as in gather.glsl: the last bit decides on which side of a pixel's border a ray is.
    return np.floor(lens.places_of(camera, flat, camera.width, camera.height).places).astype(np.intp)


def pass_of(renderer: _Renderer, what: str, samples: Samples = Samples()) -> Pass:
    """Return the pass that draws "luminance" or "colour"."""
    return {"luminance": Luminance, "colour": Colour}[what](samples, renderer.maps)


def _parts(renderer: _Renderer, name: str) -> tuple[str, Pass, Pass]:
    """Return (what the picture is of, the pass that draws it before, the pass that makes ``name`` from it)."""
    what, of_lens = name.partition("_")[0], name in LENSED
    of = pass_of(renderer, what, Samples() if of_lens else samples_of("edges"))
    return what, of, Gather(of, renderer.scene.camera, True) if of_lens else Edged(of)


def drawn(renderer: _Renderer, name: str, t_ns: int) -> np.ndarray:
    """Return the program's result, (H, W) or (H, W, 3) float32; behind a lens ``edges`` makes a flat picture. name : of
    :data:`FILTERED`, here and below."""
    what, _, pass_ = _parts(renderer, name)
    return renderer.draw(pass_, t_ns).read(what)


def reference_of(renderer: _Renderer, name: str, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (the picture that the program reads, float32; its expected result, float64)."""
    written = drawn(renderer, name, t_ns)
    what, of, _ = _parts(renderer, name)
    frame = renderer.draw(of, t_ns)
    plain = frame.read(what)
    if name in LENSED:
        return renderer.at_pixels(plain), _gathered(plain, renderer.scene.camera)
    depths, moment = frame.target.read_depth(), frame.moment
    # The sky has no silhouette: other surfaces are in front of it.
    items = [item for item in moment.visible if item.layer != SKY]
    pixels, crossings = Lines().in_pixels(moment, items, frame.width, frame.height)
    pixel = 2 / (frame.width * abs(moment.view.projection[0, 0]))
    return plain, filtered(plain, depths, pixels, crossings, pixel, written)


def _gathered(picture: np.ndarray, camera: CameraModel) -> np.ndarray:
    """Return (H, W) or (H, W, C) float64: the mean of a flat picture over each pixel of a lens, at the sample places of
    gather.glsl, each between four pixels."""
    flat, grid = seen_through(camera), pixel_grid(camera)
    rays = camera.rays(grid)
    # To first order, as in the shader: the place of the pixel's centre and its two derivatives.
    place, slopes = flat.project(rays), flat.jacobian(rays) @ camera.ray_jacobian(grid)
    columns, rows = lens.steps_of(camera, 1)
    # map_coordinates takes one channel at a time.
    channels = np.moveaxis(np.atleast_3d(picture).astype(np.float64), 2, 0)
    total = np.zeros((len(channels), len(grid)))
    for across in (np.arange(columns) + 0.5) / columns - 0.5:
        for down in (np.arange(rows) + 0.5) / rows - 0.5:
            # Rows before columns, whole numbers at the pixels' centres.
            there = (place + slopes @ [across, down])[:, ::-1].T
            total += [ndimage.map_coordinates(channel, there, order=1, mode="nearest") for channel in channels]
    mean = total.T.reshape(camera.height, camera.width, -1) / (columns * rows)
    return mean if picture.ndim == 3 else mean[..., 0]
