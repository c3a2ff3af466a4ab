"""Filtering over a pixel: edges against exact coverage, textures against the mip level that was asked for."""

import numpy as np
import pytest

from blinkgl.camera import PinHole
from blinkgl.config.problems import validate
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import ConfigError, GLError
from blinkgl.labels import LabelRequest
from blinkgl.render.antialiasing import ANTIALIASING, samples_of
from blinkgl.render.renderer import Renderer
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Material, Scene, Texture
from render_scenes import LEVEL, SECOND, mesh, mixed_scene, quad, scene, still, thing

FACING = LEVEL.as_matrix() @ np.diag([1.0, -1.0, -1.0])  # a quad's +z towards the camera at the origin


def half_plane(angle: float, offset: float, size: int = 48) -> tuple[Scene, np.ndarray]:
    """A white unlit half plane x cos + y sin < offset (px from the image's middle) on black, seen from the front; and
    its exact coverage of each pixel, by clipping pixel squares: (size, size) float64."""
    far = 4.0 * size
    normal, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    edge = offset * normal
    corners = np.array(
        [edge - far * along, edge + far * along, edge + far * along - far * normal, edge - far * along - far * normal]
    )
    depth = 10.0
    points = np.column_stack([corners * depth / size, np.full(4, depth)])  # camera axes; fx = size
    plane = thing("edge", 1, mesh(points, [[0, 1, 2], [0, 2, 3]]), still(), Material(unlit=True, both_sides=True))
    camera = Rig.alone(PinHole(size, size, size, size, (size - 1) / 2, (size - 1) / 2), still())
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return Scene((plane,), camera, 0, SECOND), half_plane_area(normal, offset - x * normal[0] - y * normal[1])


def half_plane_area(normal: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Area of {(u, v) in [-1/2, 1/2]²: n.(u, v) < c}: the integral over u of the clipped bound on v, in closed form."""
    a, b = sorted(np.abs(normal))
    ramp2 = lambda s: np.maximum(s, 0.0) ** 2 / 2
    if a < 1e-12:
        return np.clip(c / b + 0.5, 0.0, 1.0)
    return (ramp2(c + (a + b) / 2) - ramp2(c + (b - a) / 2) - ramp2(c + (a - b) / 2) + ramp2(c - (a + b) / 2)) / (a * b)


def test_the_oracle_is_the_area():
    rng = np.random.default_rng(0)
    u = rng.uniform(-0.5, 0.5, (200_000, 2))
    for normal, c in (((0.6, 0.8), 0.1), ((0.28, -0.96), -0.3), ((1.0, 0.0), 0.2)):
        assert half_plane_area(np.array(normal), np.array(c)) == pytest.approx((u @ normal < c).mean(), abs=4e-3)


@pytest.mark.parametrize("antialiasing", ["ssaa2", "ssaa4", "ssaa8"])
def test_an_edge_is_as_bright_as_it_covers_the_pixel(gl, antialiasing):
    """Every value is a whole number of samples, the mean error is zero, and no pixel is off by more than the samples
    allow; the colour pass likewise."""
    count = ANTIALIASING[antialiasing].stored
    # A straight edge misjudges at most about one row of an n x n grid.
    worst = {"ssaa2": 0.51, "ssaa4": 0.26, "ssaa8": 0.13}[antialiasing]
    errors = []
    for angle in (0.3, 1.0, 2.2, 4.0):
        for offset in (0.0, 0.21, 0.37):
            world, coverage = half_plane(angle, offset)
            with Renderer(
                gl, world, RenderConfig(antialiasing=antialiasing, image_antialiasing=antialiasing)
            ) as renderer:
                luminance, colour = renderer.luminance(0).read(), renderer.colour(0).read()
            np.testing.assert_allclose(luminance * count, np.rint(luminance * count), atol=1e-5)
            np.testing.assert_allclose(colour[..., 1], luminance, atol=1e-6)
            assert (luminance[coverage < 1e-9] == 0).all() and (luminance[coverage > 1 - 1e-9] == 1).all()
            band = (coverage > 1e-6) & (coverage < 1 - 1e-6)
            errors.append((luminance - coverage)[band])
    errors = np.concatenate(errors)
    assert np.abs(errors).max() < worst
    assert abs(errors.mean()) < 0.01
    with Renderer(gl, world, RenderConfig()) as renderer:
        single = (renderer.luminance(0).read() - coverage)[band]
    assert errors.std() < 0.62 * single.std()


def test_labels_are_never_filtered(gl):
    world = mixed_scene()
    request = LabelRequest("depth", "ids", "flow_forward")
    frames = []
    for antialiasing in ("none", "edges", "ssaa4"):
        with Renderer(gl, world, RenderConfig(antialiasing=antialiasing, image_antialiasing="edges")) as renderer:
            renderer.luminance(0).read()
            frames.append(renderer.labels(0, request, SECOND // 10))
    for other in frames[1:]:
        np.testing.assert_array_equal(frames[0].ids, other.ids)
        np.testing.assert_array_equal(frames[0].depth, other.depth)
        np.testing.assert_array_equal(frames[0].forward.flow, other.forward.flow)


# ---- textures ----------------------------------------------------------------------------------------------------


def stripes(period_texels: int, distance: float, size: int = 64) -> Scene:
    """Unlit vertical stripes; ``distance`` texels fall on a pixel."""
    texels = np.arange(1024)
    image = np.where(texels % period_texels < period_texels // 2, 1.0, 0.0).astype(np.float32)
    image = np.repeat(np.repeat(image[None, :, None], 1024, 0), 3, 2)
    flat = quad(32.0, 32.0)
    flat = type(flat)(flat.vertices, flat.faces, flat.normals, (flat.vertices[:, :2] * 64 / 1024).astype(np.float32))
    body = thing(
        "stripes",
        1,
        flat,
        still((0, distance, 0), type(LEVEL).from_matrix(FACING)),
        Material(Texture(image), unlit=True, both_sides=True),
    )
    return scene(
        [body], Rig.alone(PinHole(size, size, size, size, (size - 1) / 2, (size - 1) / 2), still((0, 0, 0), LEVEL))
    )


@pytest.mark.parametrize("bias", [-2.0, -1.0, 0.0, 1.0])
def test_mip_bias_moves_the_level_by_that_much(gl, bias):
    """Four texels on a pixel are level 2: with the bias, what is seen has the contrast that
    level 2 + bias has, sampled by hand."""
    distance, period = 4.0, 16  # 4 texels per pixel: level 2; stripes of 8 texels vanish at level 4
    contrast = {}
    for name, scene_distance, config in (
        ("biased", distance, RenderConfig(mip_bias=bias)),
        ("plain", distance, RenderConfig()),
    ):
        with Renderer(gl, stripes(period, scene_distance), config) as renderer:
            contrast[name] = float(renderer.luminance(0).read()[8:-8, 8:-8].std())
    expected = {}
    for level in (0, 1, 2, 3, 4):  # the texture's own levels, sampled by hand at the pixels' centres
        n = 2**level
        row = (np.arange(1024) % period < period // 2).astype(float).reshape(-1, n).mean(axis=1)
        at = (np.arange(64) - 31.5) * 4.0 / n - 0.5
        i = np.floor(at).astype(int)
        expected[level] = float((row[i % len(row)] * (1 - (at - i)) + row[(i + 1) % len(row)] * (at - i))[8:-8].std())
    assert contrast["biased"] == pytest.approx(expected[int(2 + bias)], abs=0.02)
    assert contrast["plain"] == pytest.approx(expected[2], abs=0.02)


def test_four_taps_of_a_linear_texture_are_one(gl):
    """The mean of four places around the centre is the value at the centre where the texture is
    linear, and unlit flat colours do not change."""
    ramp = np.repeat(np.linspace(0.1, 0.9, 256, dtype=np.float32)[None, :, None], 256, 0).repeat(3, 2)
    body = thing(
        "ramp",
        1,
        quad(1.0, 1.0),
        still((0, 2.0, 0), type(LEVEL).from_matrix(FACING)),
        Material(Texture(ramp), unlit=True, both_sides=True),
    )
    world = scene([body], Rig.alone(PinHole(64, 64, 150, 150, 31.5, 31.5), still((0, 0, 0), LEVEL)))
    with Renderer(gl, world, RenderConfig()) as one, Renderer(gl, world, RenderConfig(antialiasing="taps4")) as four:
        np.testing.assert_allclose(four.luminance(0).read()[8:-8, 8:-8], one.luminance(0).read()[8:-8, 8:-8], atol=2e-3)


# ---- bad input ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "tree, message",
    [
        ({"antialiasing": "msaa8"}, r"antialiasing"),
        (
            {"antialiasing": "msaa4"},
            r"^render.antialiasing: multi-sampling was removed \(got 'msaa4'\); expected edges",
        ),
        ({"supersample": 2}, r"unknown key"),
        ({"image_antialiasing": "taps4"}, r"image_antialiasing"),
        ({"mip_bias": 9}, r"mip_bias"),
        ({"lod": {"enabled": True}}, r"^render.lod: this key was removed \(got .*\); expected meshes that are as fine"),
        ({"lod": True}, r"^render.lod: this key was removed"),
    ],
)
def test_bad_keys_are_named(tree, message):
    with pytest.raises(ConfigError, match=message):
        validate(RenderConfig, tree, where="render")


def test_bad_samples_are_refused(gl):
    with pytest.raises(GLError, match="unknown anti-aliasing"):
        samples_of("ssaa3")


@pytest.mark.parametrize("antialiasing, blurred", [("none", 0.01), ("taps4", 0.25)])
def test_anisotropy_keeps_stripes_that_run_into_the_distance(gl, antialiasing, blurred):
    """Stripes along the view on grazing ground: a pixel is as wide as ever and very long, an
    isotropic mip level averages as wide as long."""
    image = np.zeros((64, 64, 3), np.float32)
    image[:, (np.arange(64) // 8) % 2 == 0] = 1.0
    ground = thing(
        "ground", 1, quad(40, 40, 8), still((0, 0, -1.0)), Material(Texture(image), uv_scale=(10.0, 10.0), unlit=True)
    )
    world = scene([ground], Rig.alone(PinHole(96, 64, 90.0, 90.0, 47.5, 8.0), still(rotation=LEVEL)))
    contrast = {}
    for anisotropy in (1.0, 4.0):
        config = RenderConfig(anisotropy=anisotropy, antialiasing=antialiasing, image_antialiasing="none")
        with Renderer(gl, world, config) as renderer:
            contrast[anisotropy] = renderer.luminance(0).read()[14].std(), renderer.colour(0).read()[14, :, 1].std()
    assert contrast[1.0][0] < blurred and contrast[1.0][1] < 0.01
    assert contrast[4.0][0] > 0.3 and contrast[4.0][1] > 0.3
