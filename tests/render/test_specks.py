"""Bodies under a pixel: their light is their area times their radiance, wherever they are between pixel centres."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

from blinkgl.camera import PinHole, Radtan
from blinkgl.config.sequence import RenderConfig
from blinkgl.gl import create_context
from blinkgl.render.renderer import Renderer
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Light, Material, Part, Scene, SceneObject
from render_scenes import LEVEL, SECOND, drift, mesh, quad, still

W, H, F, AWAY = 48, 32, 400.0, 40.0
SPHERE = trimesh.creation.icosphere(3)
DISC = 0.25 * np.pi  # of a square
GLOW = dict(base_color=(0, 0, 0), emission=(3.0, 3.0, 3.0), unlit=False)


def ball(x, y, px, number=1, away=AWAY, path=None, material=None):
    """A sphere ``px`` wide whose middle is at pixel (x, y)."""
    size = px / F * away / 2
    body = mesh(SPHERE.vertices * size, SPHERE.faces, SPHERE.vertex_normals, closed=True, name=f"ball {number}")
    place = ((x - (W - 1) / 2) / F * away, away, -(y - (H - 1) / 2) / F * away)
    parts = (Part(body, material or Material(**GLOW)),)
    return SceneObject(f"ball {number}", number, parts, path or still(place))


def picture(objects, *, camera=None, t_ns=0, antialiasing="edges", camera_path=None, whole=False):
    camera = camera or PinHole(W, H, F, F, (W - 1) / 2, (H - 1) / 2)
    rig = Rig.alone(camera, camera_path or still(rotation=LEVEL))
    scene = Scene(tuple(objects), rig, 0, SECOND, light=Light(sun=0.0, sky=0.0))
    with create_context() as gl, Renderer(gl, scene, RenderConfig(antialiasing=antialiasing), whole=whole) as renderer:
        return [renderer.luminance(t).read().copy() for t in np.atleast_1d(t_ns).tolist()]


@pytest.mark.parametrize(
    ("px", "samples"), [(0.01, "ssaa2"), (0.1, "ssaa2"), (0.3, "ssaa2"), (0.2, "ssaa4"), (0.1, "ssaa8"), (0.6, "ssaa8")]
)
def test_pictures_in_colour_show_them_too(px, samples):
    """Images, and the optics that need colour."""
    rng = np.random.default_rng(5)
    x, y = 20 + rng.uniform(-0.5, 0.5), 14 + rng.uniform(-0.5, 0.5)
    red = Material(base_color=(0, 0, 0), emission=(3.0, 0.5, 0.0), unlit=False)
    scene = Scene(
        (ball(x, y, px, material=red),),
        Rig.alone(PinHole(W, H, F, F, (W - 1) / 2, (H - 1) / 2), still(rotation=LEVEL)),
        0,
        SECOND,
        light=Light(sun=0.0, sky=0.0),
    )
    with create_context() as gl, Renderer(gl, scene, RenderConfig(image_antialiasing=samples)) as renderer:
        image = renderer.colour(0).read()
    due = DISC * px**2 * np.array([3.0, 0.5, 0.0])
    assert image.sum(axis=(0, 1)) == pytest.approx(due, rel=0.04 if px < 0.3 else 0.35)
    assert image.max(axis=2).any(axis=0).sum() <= 3


@pytest.mark.parametrize(
    ("px", "antialiasing"),
    [
        *((px, "edges") for px in (1e-6, 0.01, 0.05, 0.2, 0.5, 1.0, 1.4)),
        *((px, "edges2") for px in (0.01, 0.2, 0.7)),
    ],
)
def test_light_is_area_times_radiance_wherever_the_body_is(px, antialiasing):
    rng = np.random.default_rng(3)
    places = [
        (6 + 12 * (k % 4) + rng.uniform(-0.5, 0.5), 5 + 10 * (k // 4) + rng.uniform(-0.5, 0.5)) for k in range(12)
    ]
    (image,) = picture([ball(x, y, px, k + 1) for k, (x, y) in enumerate(places)], antialiasing=antialiasing)
    for x, y in places:
        window = image[round(y) - 3 : round(y) + 4, round(x) - 3 : round(x) + 4]
        assert window.sum() == pytest.approx(3 * DISC * px**2, rel=0.04)
        rows, columns = np.mgrid[round(y) - 3 : round(y) + 4, round(x) - 3 : round(x) + 4]
        middle = [(window * at).sum() / window.sum() for at in (columns, rows)]
        # A body within one pixel does not say where in it; a wider one does.
        assert np.abs(np.subtract(middle, (x, y))).max() < max(0.52 - 0.3 * px, 0.1)


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.5])
def test_pixels_share_it_as_samples_do(offset):
    body, fine = ball(20 + offset, 12.2, 1.2), PinHole(8 * W, 8 * H, 8 * F, 8 * F, 8 * W / 2 - 0.5, 8 * H / 2 - 0.5)
    (image,), (samples,) = picture([body]), picture([body], antialiasing="none", camera=fine)
    samples = samples.reshape(H, 8, W, 8).mean(axis=(1, 3))
    assert samples.max() > 1 and np.abs(image - samples).max() < 0.1


def test_what_is_nearer_hides_it_and_what_is_farther_does_not():
    wall = lambda away: SceneObject(
        "wall", 9, (Part(quad(9, 9), Material(base_color=(0, 0, 0), emission=(0.5,) * 3)),), still((0, away, 0), LEVEL)
    )
    (before,), (behind,) = (picture([ball(20.3, 12.4, 0.5), wall(away)]) for away in (AWAY / 2, AWAY * 2))
    assert np.ptp(before) < 1e-6
    assert (behind - 0.5).sum() == pytest.approx(2.5 * DISC * 0.25, rel=0.03)


def test_the_nearer_of_two_is_in_front():
    dark = Material(base_color=(0, 0, 0), unlit=True)
    (image,) = picture([ball(20, 12, 1.0), ball(20, 12, 1.0, 2, AWAY / 2, material=dark)])
    assert image[12, 20] == pytest.approx(3 * DISC * (1 - DISC), rel=0.08)


@pytest.mark.parametrize("moves", ["body", "camera"])
def test_a_moving_one_is_drawn_by_its_place_at_each_time(moves):
    ways = {"path": drift(*(ball(x, 12, 1).path.pose(0)[:3, 3] for x in (10, 30)))} if moves == "body" else {}
    view = {"camera_path": drift((0, 0, 0), (2, 0, 0), LEVEL)} if moves == "camera" else {}
    bodies = [ball(10, 12, 0.4, **ways), ball(40, 25, 6.0, 2)]
    for whole in (False, True):
        images = picture(bodies, t_ns=[0, SECOND // 4, SECOND // 2], whole=whole, **view)
        sums = [image[6:18].sum() for image in images]
        assert sums == pytest.approx([3 * DISC * 0.16] * 3, rel=0.03)
        assert len({int(image[6:18].sum(axis=0).argmax()) for image in images}) == 3


def test_through_a_lens():
    camera = Radtan(W, H, F, F, (W - 1) / 2, (H - 1) / 2, k1=-0.2, k2=0.05)
    (image,) = picture([ball(20.2, 12.3, 0.6)], camera=camera)
    assert image.sum() == pytest.approx(3 * DISC * 0.36, rel=0.1)


def test_in_fog_and_with_many_parts():
    two = ball(20.2, 12.3, 0.4)
    both = dataclasses.replace(two, parts=(*two.parts, *ball(20.2, 12.3, 0.4, away=AWAY).parts))
    assert picture([both])[0].sum() == pytest.approx(3 * DISC * 0.16, rel=0.03), "parts in one place count once"


def test_a_body_without_width_has_no_light():
    assert picture([ball(20.2, 12.3, 1e-6)])[0].max() < 1e-9
    assert picture([])[0].max() == 0


def test_more_than_fit_into_a_row_of_portraits():
    bodies = [ball(2 + k % 44, 2 + k // 44, 0.3, k + 1) for k in range(200)]
    (image,) = picture(bodies)
    assert image.sum() == pytest.approx(200 * 3 * DISC * 0.09, rel=0.03)


def test_with_samples_instead_of_lines():
    for antialiasing in ("ssaa2", "ssaa4"):
        (image,) = picture([ball(20.3, 12.4, 0.2)], antialiasing=antialiasing)
        assert image.sum() == pytest.approx(3 * DISC * 0.04, rel=0.03)


def test_more_specks_than_fit_are_said_and_the_nearest_are_right(monkeypatch):
    monkeypatch.setattr("blinkgl.render.renderer._MOST_SPECKS", 3)
    near = [ball(8.3 + 10 * k, 12.4, 0.2, k + 1) for k in range(3)]
    far = [ball(8.3 + 10 * k, 24.4, 0.2, k + 4, away=2 * AWAY) for k in range(4)]
    rig = Rig.alone(PinHole(W, H, F, F, (W - 1) / 2, (H - 1) / 2), still(rotation=LEVEL))
    scene = Scene((*near, *far), rig, 0, SECOND, light=Light(sun=0.0, sky=0.0))
    with create_context() as gl, Renderer(gl, scene, RenderConfig(antialiasing="edges")) as renderer:
        image = renderer.luminance(0).read()
        assert renderer.notes and renderer.notes[0].startswith("7 bodies under a pixel: the nearest 3 shine")
    assert image[:18].sum() == pytest.approx(3 * 3 * DISC * 0.04, rel=0.04)
