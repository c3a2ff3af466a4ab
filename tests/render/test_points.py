"""Points of light: the primitive ``point``, whose emission is its intensity: radiance times area."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl import (
    Camera,
    ConfigError,
    Keyframes,
    Light,
    Material,
    Pose,
    Primitive,
    Renderer,
    Scene,
    record,
    render_frame,
)
from blinkgl.config.run import RunTemplate
from blinkgl.front.runs import configured
from blinkgl.sequence import simulate_sequence
from blinkgl.sequence.request import Picture, SequenceRequest

FOCAL = 300.0
SPAN = dict(light=Light(0, 0), background=0.0, duration=0.05, label_rate=20)


def glowing(*rgb: float) -> Material:
    return Material(color=(0, 0, 0), emission=rgb)


def luminance(scene: Scene) -> np.ndarray:
    with Renderer(scene) as renderer:
        return renderer.luminance(0.0)


def stars(**more) -> Scene:
    """Three points at distances of 1, 8 and 3000 m."""
    scene = Scene(Camera(64, 48, focal=FOCAL, pose=Pose((0, 0, 0), look_at=(1, 0, 0))), **{**SPAN, **more})
    for distance, column in ((1.0, -20), (8.0, 0), (3000.0, 20)):
        place = distance * np.array([1, -column / FOCAL, 0.02])
        scene += Primitive("point", pose=Pose(place), material=glowing(2.0 * distance**2, distance**2, 0.0))
    return scene


def test_a_point_adds_its_intensity_by_the_square_of_its_distance():
    """The inverse square law, in pixels: intensity * (focal / depth)², in luminance by Rec. 709 and in colour."""
    for image, weights in (
        (luminance(stars()), 0.2126 * 2 + 0.7152),
        (render_frame(stars(), 0.0).colour, np.array([2.0, 1.0, 0.0])),
    ):
        sums = [image[:, 32 + at - 5 : 32 + at + 6].sum(axis=(0, 1)) for at in (-20, 0, 20)]
        for one in sums:
            assert one == pytest.approx(weights * FOCAL**2, rel=0.03)


def test_scale_is_that_of_its_size():
    scene = Scene(Camera(32, 24, focal=FOCAL), **SPAN)
    scene += Primitive("point", scale=3.0, pose=Pose((2, 0, 0)), material=glowing(1, 1, 1))
    assert luminance(scene).sum() == pytest.approx(9 * (FOCAL / 2) ** 2, rel=0.03)


@pytest.mark.parametrize(
    ("material", "more"),
    [(Material(), {}), (Material(color=(1, 0, 0)), {}), (glowing(1, 1, 1), {"light": Light(unlit=True)})],
)
def test_a_dark_point_is_refused(material, more):
    scene = Scene(Camera(32, 24), **{**SPAN, **more})
    scene += Primitive("point", pose=Pose((2, 0, 0)), material=material)
    with pytest.raises(ConfigError, match="a point of light that emits none"):
        luminance(scene)


def test_without_anti_aliasing_a_line_says_that_it_is_not_seen():
    for antialiasing, said in (("none", True), ("edges", False)):
        template = configured(stars(), labels=[])
        tree = {**template.tree, "render": {"antialiasing": antialiasing}}
        config = RunTemplate(tree, template.base).sequence(0)
        with simulate_sequence(SequenceRequest(config, scene=stars().build(config))) as sequence:
            line = "3 bodies under a pixel shine only where they meet a pixel's centre"
            assert any(note.startswith(line) for note in sequence.alone.notes) == said


@pytest.mark.parametrize("emulator", ["esim", "v2e"])
@pytest.mark.parametrize("lens", [{}, {"lens": "radtan", "distortion": (-0.2, 0.05, 0.0, 0.0)}])
def test_events_of_points_are_theirs(emulator, lens):
    """No pixel's centre meets a point; instance, depth and velocity of its events are the point's, by projection."""
    scene = Scene(
        Camera(64, 48, focal=FOCAL, pose=Pose((0, 0, 0), look_at=(1, 0, 0)), **lens), **{**SPAN, "duration": 0.1}
    )
    scene += Primitive("cuboid", extents=(0.1, 8, 8), pose=Pose((9, 0, 0)), material=Material(color=(0.2,) * 3))
    for number, (speed, height) in enumerate([(0.6, 0.1), (-0.9, -0.1)]):
        way = Keyframes({0.0: Pose((4, 0, height)), 1.0: Pose((4, speed, height))}, interpolation="linear")
        scene += Primitive("point", pose=way, material=glowing(4e-3, 4e-3, 4e-3), name=f"drone {number}")
    truth = record(scene, emulator=emulator, labels=["events"]).events.truth
    numbers, counts = np.unique(truth["instance"], return_counts=True)
    assert counts[np.isin(numbers, (2, 3))].sum() > 0.95 * len(truth) > 50
    for number, speed in ((2, 0.6), (3, -0.9)):
        mine = truth[truth["instance"] == number]
        assert len(mine) > 20 and np.allclose(mine["depth"], 4, atol=1e-3)
        # +x is to the right, +y of the world to the left; a lens stretches by at most a few percent here.
        assert np.allclose(mine["velocity"][:, 0], -speed * FOCAL / 4, rtol=0.06 if lens else 1e-4)


def test_the_preview_shows_them():
    template = configured(stars(), labels=[])
    config = RunTemplate(template.tree, template.base).sequence(0)
    request = SequenceRequest(config, scene=stars().build(config), pictures_hz=20.0)
    with simulate_sequence(request) as sequence:
        images = [item.image for item in sequence.alone if isinstance(item, Picture)]
    assert images and all((image[..., 0] > 1).sum() >= 3 for image in images)
