"""Passes that read passes, and the handles of what they draw. The toys are defined here and nowhere else;
docs/extending.md leads here."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from scipy import ndimage

from blinkgl.camera import PinHole
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import GLError
from blinkgl.gl.shader import ShaderError
from blinkgl.labels import LabelRequest
from blinkgl.render import casting
from blinkgl.render.frames import DEPTH_BUFFER
from blinkgl.render.moment import View
from blinkgl.render.passes import Geometry, Input, Output, ScenePass, ScreenPass
from blinkgl.render.renderer import Renderer
from render_scenes import SECOND, cube, drift, mixed_scene, quad, scene, still, thing

PLAIN = RenderConfig(image_antialiasing="none")
TOYS = Path(__file__).parent / "toys"


# --- a pass that reads another one's picture --------------------------------------------------------------------------


@dataclass(frozen=True)
class EdgeBand(ScreenPass):
    """1 within ``reach`` px of a pixel that shows another object, else 0."""

    reach: int = 1
    program: ClassVar[str] = str(TOYS / "edge_band.glsl")
    inputs: ClassVar[tuple[Input, ...]] = (Input("ids", Geometry(("ids",))),)
    outputs: ClassVar[tuple[Output, ...]] = (Output("edge", "R32UI"),)

    def defines(self, kind):
        return {"REACH": self.reach}


# --- a pass from elsewhere, and one that reads its depth buffer -------------------------------------------------------


@dataclass(frozen=True)
class ShadowMap(ScenePass):
    """What a lamp at ``place``, looking along -z, sees: nothing but depth."""

    place: tuple[float, float, float]
    program: ClassVar[str] = str(TOYS / "shadow_map.glsl")
    outputs: ClassVar[tuple[Output, ...]] = ()
    depth: ClassVar[str] = "texture"

    def size(self, width, height):
        return 512, 512

    def seen(self, moment):
        downwards = np.diag([1.0, -1.0, -1.0, 1.0])
        downwards[:3, 3] = self.place
        return moment.from_place(View.of(PinHole.centred(512, 512, 200.0, 200.0)), downwards)


@dataclass(frozen=True)
class Lamplight(ScenePass):
    """1 where the lamp is seen from the surface, 0 in the shadow of something."""

    shadows: ShadowMap
    program: ClassVar[str] = str(TOYS / "lamplight.glsl")
    outputs: ClassVar[tuple[Output, ...]] = (Output("light", "R32F"),)

    @property
    def inputs(self):
        return (Input("shadows", self.shadows, DEPTH_BUFFER),)

    def set(self, painter, uniforms, item, shot):
        lamp = shot.inputs["shadows"].moment
        uniforms["lamp_from_local"].write(np.ascontiguousarray(lamp.mvp[item.object_index].T, np.float32).tobytes())


def test_a_pass_reads_another(gl):
    world = mixed_scene()
    with Renderer(gl, world, PLAIN) as renderer:
        for t in (0, SECOND // 3):
            ids = renderer.labels(t, LabelRequest("ids")).ids.astype(int)
            for reach in (1, 3):
                edges = renderer.draw(EdgeBand(reach), t).read()
                window = {"size": 2 * reach + 1, "mode": "nearest"}
                np.testing.assert_array_equal(
                    edges, ndimage.maximum_filter(ids, **window) != ndimage.minimum_filter(ids, **window)
                )
                assert 0 < edges.mean() < 0.9
        assert {dict(defines).get("REACH") for name, defines in gl.shaders.compiled if name == EdgeBand.program} == {
            "1",
            "3",
        }


def test_a_shadow_map_is_a_pass_before_a_pass(gl):
    """A box over a floor, lit from above: shadows where a ray from the surface to the
    lamp, cast in float64, meets the box."""
    lamp, facing_up = np.array([0.4, 4.0, 3.0]), np.array([0.0, 0.0, 1.0])
    world = scene(
        [
            thing("floor", 1, quad(6, 6), still((0, 4, -1))),
            thing("box", 2, cube(0.4), drift((-0.5, 4, 0.2), (0.5, 4, 0.2))),
        ]
    )
    with Renderer(gl, world, PLAIN) as renderer:
        for t in (0, 3 * SECOND // 4):
            light = renderer.draw(Lamplight(ShadowMap(tuple(lamp))), t).read()
            hits = casting.cast(world, t)
            floor = (hits.instance == 1).reshape(light.shape)
            box = world.objects[1].path.pose(t)[:3, 3]
            points = np.where(hits.instance[:, None] == 1, hits.local + world.objects[0].path.pose(t)[:3, 3], facing_up)
            with np.errstate(divide="ignore"):
                ends = (box + np.array([[-0.4], [0.4]])[:, None] - points) / (lamp - points)
            inside = ends.min(0).max(-1) < ends.max(0).min(-1)
            shadow = (inside & (ends.min(0).max(-1) > 1e-6)).reshape(light.shape)
            wrong = floor & (light != np.where(shadow, 0.0, 1.0))
            rim = ndimage.binary_dilation(shadow) != ndimage.binary_erosion(shadow)
            assert 30 < (floor & shadow).sum() < floor.sum() / 2
            assert not (wrong & ~rim).any() and wrong.sum() <= 0.2 * (floor & rim).sum()


def test_mistakes_of_a_pass_are_named(gl):
    @dataclass(frozen=True)
    class Wrong(EdgeBand):
        inputs: ClassVar[tuple[Input, ...]] = (Input("ids", Geometry(("ids",)), "depht"),)

    @dataclass(frozen=True)
    class NoDepth(EdgeBand):
        inputs: ClassVar[tuple[Input, ...]] = (Input("ids", Geometry(("ids",)), DEPTH_BUFFER),)

    @dataclass(frozen=True)
    class Nowhere(EdgeBand):
        program: ClassVar[str] = str(TOYS / "nowhere.glsl")

    with Renderer(gl, mixed_scene(48, 36), PLAIN) as renderer:
        with pytest.raises(GLError, match="Geometry: the pass has no such output .got 'depht'.; expected ids"):
            renderer.draw(Wrong(), 0)
        with pytest.raises(GLError, match="Geometry: the pass has no readable depth buffer"):
            renderer.draw(NoDepth(), 0)
        with pytest.raises(ShaderError, match="no such shader file .got '.*nowhere.glsl'"):
            renderer.draw(Nowhere(), 0)
        with pytest.raises(GLError, match="the pass has no such output .got 'rate'.; expected luminance"):
            renderer.luminance(0).read("rate")
        with pytest.raises(GLError, match="ShadowMap: the pass has no such output .got ''.; expected none"):
            renderer.draw(ShadowMap((0.0, 0.0, 3.0)), 0).read()


def test_the_page_leads_to_these_toys():
    text = (Path(__file__).parents[2] / "docs" / "extending.md").read_text(encoding="utf-8")
    section = text.partition("## A pass")[2].partition("\n## ")[0]
    assert EdgeBand.__name__ in section and "tests/render/test_passes.py" in section


# --- handles ----------------------------------------------------------------------------------------------------------


MAXIMUM = """
#version 430
layout(local_size_x = 1) in;
uniform sampler2D image;
layout(std430, binding = 0) buffer Result { float largest; };
void main()
{
    ivec2 size = textureSize(image, 0);
    largest = 0.0;
    for (int y = 0; y < size.y; ++y)
        for (int x = 0; x < size.x; ++x)
            largest = max(largest, texelFetch(image, ivec2(x, y), 0).r);
}
"""


def test_a_frame_stays_on_the_card_until_it_is_read(gl):
    """A compute shader takes it from there; nothing has been transferred by then."""
    largest = gl.ctx.buffer(reserve=4)
    kernel = gl.ctx.compute_shader(MAXIMUM)
    with Renderer(gl, mixed_scene(48, 36), RenderConfig(antialiasing="ssaa2")) as renderer:
        frame = renderer.luminance(SECOND // 3)
        frame.texture().use(3)
        kernel["image"].value = 3
        largest.bind_to_storage_buffer(0)
        kernel.run()
        gl.ctx.memory_barrier()
        found = np.frombuffer(largest.read(), np.float32)[0]
        assert renderer.stats.readback_s == 0.0
        assert found == frame.read().max() > 0 and renderer.stats.readback_s > 0.0
        assert (frame.width, frame.height, frame.t_ns, frame.names) == (48, 36, SECOND // 3, ("luminance",))
    for resource in (kernel, largest):
        resource.release()


def test_a_frame_that_was_drawn_over_says_so(gl):
    with Renderer(gl, mixed_scene(48, 36), PLAIN) as renderer:
        first, other, small = renderer.luminance(0), renderer.brightness(0), renderer.velocity(0, 4)
        image = first.read()
        second = renderer.luminance(SECOND // 2)
        for use in (first.read, first.view, first.texture):
            with pytest.raises(GLError, match="frame at 0 s: this frame is no longer on the GPU"):
                use()
        assert not np.array_equal(image, second.read())
        np.testing.assert_array_equal(image, other.read()[..., 0])
        assert small.read().shape == (9, 12, 2)
        renderer.forget()
        with pytest.raises(GLError, match="frame at 0.5 s"):
            second.read()


@pytest.mark.parametrize("antialiasing", ["none", "ssaa2"])
def test_what_is_read_what_is_viewed_and_what_is_written_into_are_one(gl, antialiasing):
    config = RenderConfig(antialiasing=antialiasing, image_antialiasing=antialiasing)
    with Renderer(gl, mixed_scene(48, 36), config) as renderer:
        for t in (0, SECOND // 5):
            frames = [
                renderer.luminance(t),
                renderer.brightness(t, 5),
                renderer.velocity(t, 3),
                renderer.colour(t),
                renderer.draw(Geometry(("depth", "ids", "normals")), t),
            ]
            for frame in frames:
                for name in frame.names:
                    image = frame.read(name)
                    assert (
                        image.flags.owndata
                        and image.flags.c_contiguous
                        and image.shape[:2] == (frame.height, frame.width)
                    )
                    out = np.empty_like(image)
                    assert frame.read(name, out) is out
                    np.testing.assert_array_equal(image, out)
                    np.testing.assert_array_equal(image, frame.view(name))
                    assert np.shares_memory(frame.view(name), frame.view(name)) and not np.shares_memory(
                        frame.view(name), image
                    )
                    for wrong in (
                        np.empty((3, 3), image.dtype),
                        np.empty(image.shape, np.float64),
                        np.asfortranarray(image),
                    ):
                        if wrong.shape != image.shape or wrong.dtype != image.dtype or not wrong.flags.c_contiguous:
                            with pytest.raises(ValueError, match="out must be a C-contiguous"):
                                frame.read(name, wrong)
            assert frames[3].read().shape == (36, 48, 3) and frames[0].names == ("luminance",)
