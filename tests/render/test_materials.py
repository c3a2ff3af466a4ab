"""Surfaces that are more than matt: OpenGL against the float64 reference, and the reference against integrals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl.config.sequence import RenderConfig
from blinkgl.labels import LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.scene.geometry.tangents import split_mirrored, tangents
from blinkgl.scene.lights import lamp_pose
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.surfaces import gloss
from blinkgl.scene.types import Gloss, Lamp, Light, Map, Mask, Material, Scene, Texture
from blinkgl.tools.shader_debugger import appearance, reference
from tests.render.render_scenes import drift, pose, quad, rates, rig, scene, smooth_texture, sphere, still, thing

T = 300_000_000
Y, X = np.mgrid[0:16, 0:16] / 16 * 2 * np.pi
BUMPS = np.stack([128 + 60 * np.sin(X), 128 + 60 * np.cos(Y), np.full_like(X, 240)], axis=2).astype(np.uint8)
ROUGH = np.stack([0 * X, 150 + 90 * np.sin(X), 128 + 120 * np.cos(Y)], axis=2).astype(np.uint8)
ALPHA = (127 + 127 * np.sin(X) * np.sin(Y)).astype(np.uint8)
TEXTURE = smooth_texture(1, 16)
LAMPS = Light(
    sun=0.5,
    sky=0.4,
    sky_color=(0.5, 0.7, 1.0),
    lamps=(
        Lamp("point", (4.0, 3.0, 2.0), StaticPath(lamp_pose((1, 1, 1.5)))),
        Lamp("spot", (9.0, 9.0, 9.0), StaticPath(lamp_pose((-1, 1.5, 1.5), (1, 1.5, -1.5)))),
    ),
)
EVEN = Light(  # 1 from every direction
    sun=0.0,
    sky=0.0,
    quadric=tuple(tuple(tuple(float(i == j == 3) for j in range(4)) for i in range(4)) for _ in range(3)),
)
PLAIN = RenderConfig(antialiasing="none", image_antialiasing="none")


def numbers(image) -> Map:
    return Map(Texture(image))


def coloured(seed=0):
    return replace(quad(splits=8), colours=np.random.default_rng(seed).uniform(0, 1, (81, 3)).astype(np.float32))


MATERIALS = {
    "vertex colours": (Material(), coloured()),
    "vertex colours on a texture": (Material(TEXTURE), coloured()),
    "unlit vertex colours": (Material(TEXTURE, unlit=True), coloured()),
    "own light": (Material(TEXTURE, emission=(0.3, 0.2, 0.1)), quad(splits=8)),
    "own light from a map": (
        Material(TEXTURE, emission=(2.0, 1, 0.5), emission_map=numbers(TEXTURE.image)), quad(splits=8),
    ),
    "plastic": (Material(TEXTURE, gloss=Gloss(0, 0.3)), sphere()),
    "gold": (Material(base_color=(1, 0.8, 0.3), gloss=Gloss(1, 0.3)), sphere()),
    "half a metal": (Material(TEXTURE, gloss=Gloss(0.5, 0.5)), sphere()),
    "roughness from a map": (Material(TEXTURE, gloss=Gloss(1, 1, numbers(ROUGH))), quad(splits=8)),
    "normal map": (Material(TEXTURE, bumps=numbers(BUMPS)), quad(splits=8)),
    "all maps, elsewhere": (
        Material(
            gloss=Gloss(1, 0.6, Map(Texture(ROUGH), (1.5, 0, 0.2, 0, 2, 0))),
            bumps=Map(Texture(BUMPS), (0, 2, 0.1, -3, 0, 0.2), ("mirror", "clamp")),
            bump_scale=0.5,
        ),
        quad(splits=8),
    ),
    "holes": (Material(TEXTURE, mask=Mask(ALPHA)), quad(splits=8)),
    "clamped and mirrored": (Material(TEXTURE, uv_scale=(3, 3), wrap=("clamp", "mirror")), quad(splits=8)),
}  # fmt: skip


def moving(material, mesh, light) -> Scene:
    turned = [Rotation.from_euler("x", angle, degrees=True) for angle in (70, 80)]
    return scene([thing("it", 1, mesh, drift((0, 3, 0), (0.3, 3.2, 0.1), *turned), material)], light=light)


@pytest.mark.parametrize(
    "name, light",
    [(name, LAMPS) for name in MATERIALS] + [(name, Light()) for name in ("plastic", "gold", "normal map")],
)
def test_against_the_reference(gl, name, light):
    """Luminance, of one channel or three, and colour, under lamps and under the plain sun and sky."""
    made = moving(*MATERIALS[name], light)
    with Renderer(gl, made, PLAIN) as renderer:
        luminance, colour = renderer.luminance(T).read(), renderer.colour(T).read()
    known = reference.render(made, T)
    inside = known.hit & ~reference.silhouette_band(known.instance, known.depth, 2)
    assert inside.sum() > 2000
    for drawn, right in ((luminance, known.luminance), (colour, known.colour)):
        error = np.abs(drawn - right)[inside]
        assert np.median(error) < 1e-5 and error.max() < 1e-3 * max(1.0, right[inside].max()), name
    assert ((luminance > 0) == known.hit).mean() > 0.999  # holes are where they are


@pytest.mark.parametrize(
    "name", ["vertex colours on a texture", "own light from a map", "plastic", "gold", "normal map"]
)
def test_rates(gl, name):
    """dL/dt against the difference of two frames, under lamps, moving and turning."""
    made = moving(*MATERIALS[name], LAMPS)
    with Renderer(gl, made, PLAIN) as renderer:
        rate, true = rates(renderer, T)
    known = reference.render(made, T)
    inside = known.hit & ~reference.silhouette_band(known.instance, known.depth, 3)
    change = true[inside]
    error = np.abs(rate[inside] - change)
    assert np.quantile(error, 0.9) < 0.03 * np.quantile(np.abs(change), 0.99), name


def test_a_furnace(gl):
    """Constant radiance from all around: what reflects all of it cannot be seen, whatever its metal and roughness."""
    for metallic in (0.0, 0.4, 1.0):
        for roughness in (0.0, 0.3, 1.0):
            made = scene(
                [thing("it", 1, sphere(), still((0, 3, 0)), Material(gloss=Gloss(metallic, roughness)))], light=EVEN
            )
            with Renderer(gl, made, PLAIN) as renderer:
                image = renderer.colour(0).read()
            hit = image.max(axis=2) > 0
            assert np.abs(image[hit] - 1.0).max() < 1e-3, (metallic, roughness)


def brute_energy(nv: float, roughness: float, base: float, n: int = 1200) -> float:
    """Of even light, what a lobe with Schlick's term sends back once through: over half vectors, by the rule of the
    middle in the angle, with D's own substitution."""
    a = roughness**2
    u = (np.arange(n) + 0.5) / n
    cos_h = np.sqrt((1 - u) / (1 + (a * a - 1) * u))  # equal shares of D cos
    phi = (np.arange(n) + 0.5) / n * np.pi
    sin_h = np.sqrt(1 - cos_h**2)
    v = np.array([np.sqrt(1 - nv**2), 0.0, nv])
    h = np.stack(np.broadcast_arrays(sin_h[:, None] * np.cos(phi), sin_h[:, None] * np.sin(phi), cos_h[:, None]), -1)
    vh = h @ v
    nl = 2 * vh * h[..., 2] - nv

    def smith(c):
        return (np.sqrt(1 + a * a * (1 / np.maximum(c, 1e-9) ** 2 - 1)) - 1) / 2

    masked = 1 / (1 + smith(nv) + smith(nl))
    fresnel = base + (1 - base) * (1 - np.clip(vh, 0, 1)) ** 5
    weight = np.where((nl > 0) & (vh > 0), masked * fresnel * vh / (nv * h[..., 2]), 0.0)
    return float(weight.mean())


@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.6, 1.0])
def test_energy_of_a_lobe(roughness):
    """The table that shaders look up, against an integral of its own, over angles and two reflectances: 2 % asked."""
    for nv in (0.1, 0.3, 0.6, 0.95):
        r, g = gloss.energy_at(np.array([nv]), np.array([roughness]))[0]
        for base in (0.04, 0.9):
            assert base * r + g == pytest.approx(brute_energy(nv, roughness, base), rel=0.02, abs=2e-4), (nv, base)


@pytest.mark.parametrize("metallic, roughness", [(0.0, 0.25), (1.0, 0.25), (1.0, 0.7), (0.5, 1.0)])
def test_lamps_and_surroundings_are_one(metallic, roughness):
    """A sky of lamps, one per small patch, lights a surface as the even sky that they make up does: lobe, table and
    Fresnel belong together (2 %)."""
    n, total = 64, np.zeros(3)
    albedo, normal = np.array([[0.8, 0.5, 0.2]]), np.array([[0.0, 0.0, 1.0]])
    eye = np.array([[np.sin(0.7), 0.0, np.cos(0.7)]])
    z = (np.arange(n) + 0.5) / n
    azimuth = (np.arange(4 * n) + 0.5) / (4 * n) * 2 * np.pi
    directions = np.stack(np.broadcast_arrays(
        np.sqrt(1 - z**2)[:, None] * np.cos(azimuth), np.sqrt(1 - z**2)[:, None] * np.sin(azimuth), z[:, None]
    ), -1).reshape(-1, 3)  # fmt: skip
    solid = 2 * np.pi / len(directions)
    half = directions + eye
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    nl, edge = directions[:, 2], (1 - half @ eye[0]) ** 5
    lobe = gloss.lobe(nl, eye[0, 2], half[:, 2], np.full(len(nl), roughness)) / np.pi
    part = gloss.energy_at(eye[:, 2], np.array([roughness]))[0]
    lost = 1 / part.sum() - 1
    rough = np.array([roughness])
    clear = 1 + gloss.several(np.array([[gloss.DIELECTRIC]]), rough)[0, 0] * lost
    for c in range(3):
        metal = (1 + gloss.several(albedo, rough)[0, c] * lost) * (albedo[0, c] + (1 - albedo[0, c]) * edge)
        plain = clear * (gloss.DIELECTRIC + (1 - gloss.DIELECTRIC) * edge)
        total[c] = (lobe * nl * ((1 - metallic) * plain + metallic * metal)).sum() * solid
    made = scene([], light=EVEN)
    light = appearance.received(made, 0, np.zeros((1, 3)), normal)
    _, mirrored = appearance.shone(
        made, 0, light, np.zeros((1, 3)), normal, eye, albedo, np.array([metallic]), np.array([roughness])
    )
    assert mirrored[0] == pytest.approx(total, rel=0.02)


def test_tangents_run_with_the_texture():
    """Of a plane dp/du itself; of a ball along its surface; of a mirrored picture the other hand, with two vertices
    where the two meet."""
    plane = quad(splits=3)
    assert np.allclose(tangents(plane), [1, 0, 0, 1], atol=1e-6)
    ball = sphere()
    along = tangents(ball)
    assert np.abs((along[:, :3] * ball.normals).sum(axis=1)).max() < 1e-5
    assert np.allclose(np.linalg.norm(along[:, :3], axis=1), 1, atol=1e-6)
    blank = replace(ball, uvs=np.zeros_like(ball.uvs))  # says nothing: any direction in the surface
    along = tangents(blank)
    assert np.abs((along[:, :3] * blank.normals).sum(axis=1)).max() < 1e-5
    assert np.allclose(np.linalg.norm(along[:, :3], axis=1), 1, atol=1e-6)
    odd = quad(splits=4)
    odd = replace(odd, uvs=np.column_stack([np.abs(odd.uvs[:, 0] - 0.5), odd.uvs[:, 1]]).astype(np.float32))
    whole, index = split_mirrored(odd)
    assert len(whole.vertices) == len(odd.vertices) + 5 and np.array_equal(whole.vertices, odd.vertices[index])
    left = whole.vertices[whole.faces].mean(axis=1)[:, 0] < 0
    for side, expected in ((left, [-1, 0, 0, -1]), (~left, [1, 0, 0, 1])):
        assert np.allclose(tangents(whole)[whole.faces[side]], expected, atol=1e-6)
    assert split_mirrored(plane)[0] is plane


def test_a_bump_faces_where_its_normal_says(gl):
    """A normal map that leans right by 45 degrees in the picture, on a plane that faces a sun: cos 45 of its light; the
    mirrored picture and the back lean the other way."""
    lean = np.full((4, 4, 3), 128, np.uint8)
    lean[..., 0] = lean[..., 2] = 218  # (90.5, 0.5, 90.5) / 127.5
    n = (2 * np.array([218, 128, 218]) / 255 - 1) / np.linalg.norm(2 * np.array([218, 128, 218]) / 255 - 1)
    facing = pose((0, 3, 0), Rotation.from_euler("x", 90, degrees=True))
    for towards in ((0.6, -0.8, 0.0), (-0.6, -0.8, 0.0)):
        light = Light(sun_direction=towards, sun=1.0, sky=0.0)
        made = scene([thing("it", 1, quad(), StaticPath(facing), Material(bumps=numbers(lean)))], light=light)
        with Renderer(gl, made, PLAIN) as renderer:
            middle = renderer.luminance(0).read()[60, 80]
        assert middle == pytest.approx(max(0.0, n @ [towards[0], 0.0, -towards[1]]), abs=2e-3)


# ---- holes ---------------------------------------------------------------------------------------------------------


def hidden_ball(path=None) -> Scene:
    """A card with holes before a ball, and a floor under them, in the sun."""
    card = thing("card", 1, quad(splits=4), path or still((0, 2, 0), Rotation.from_euler("x", 90, degrees=True)),
                 Material(TEXTURE, uv_scale=(2, 2), mask=Mask(ALPHA)))  # fmt: skip
    ball = thing("ball", 2, sphere(), still((0, 4, 0)), Material(TEXTURE))
    floor = thing("floor", 3, quad(6, 6), still((0, 3, -1)), Material())
    return scene([card, ball, floor], rig(), Light(sun=0.7, sky=0.3, shadows="hard"))


def test_every_pass_sees_the_same_holes(gl):
    """Labels, velocity and event frames of one grid cut out the same pixels; the float64 rays go through the same
    ones, but for those that touch a rim."""
    turned = Rotation.from_euler("x", 90, degrees=True)
    made = hidden_ball(drift((0, 2, 0), (0.4, 2, 0.1), turned))
    with Renderer(gl, made, PLAIN) as renderer:
        ask = LabelRequest("flow_forward", "depth", "ids", "occlusion_forward")
        labels = renderer.labels(T, ask, t_forward_ns=T + 200_000_000).values
        velocity = renderer.velocity(T).read()
        drawn = renderer.luminance(T).read()
    known = reference.render(made, T, forward_ns=T + 200_000_000)
    assert set(np.unique(labels["ids"])) == {0, 1, 2, 3}
    assert (labels["ids"] != known.instance).mean() < 2e-3
    card = labels["ids"] == 1
    assert np.array_equal(np.abs(velocity).max(axis=2) > 1e-3, card)  # all that moves
    same = (labels["ids"] == known.instance) & ~reference.silhouette_band(known.instance, known.depth)
    assert np.abs(drawn - known.luminance)[same & card].max() < 1e-3
    valid = known.forward.valid & (labels["ids"] == known.instance)
    wrong = (labels["occlusion_forward"] != known.forward.occluded)[valid & (labels["ids"] > 1)]
    assert known.forward.occluded[labels["ids"] > 1].mean() > 0.05 and wrong.mean() < 0.005


def test_light_falls_through_holes(gl):
    """The shadow of a card with holes, hard, against float64 rays to the sun."""
    turned = Rotation.from_euler("x", 60, degrees=True)
    made = hidden_ball(still((0, 3, 0.8), turned))
    with Renderer(gl, made, PLAIN) as renderer:
        drawn = renderer.luminance(0).read()
    known = reference.render(made, 0)
    floor = known.instance == 3
    wrong = np.abs(drawn - known.luminance) > 0.1
    shaded = known.luminance < 0.35
    assert 0.05 < shaded[floor].mean() < 0.9 and wrong[floor].mean() < 0.03
