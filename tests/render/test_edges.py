"""`antialiasing: edges`: silhouettes and creases by the areas of their surfaces, taps along the foreshortening."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole, Radtan
from blinkgl.config.sequence import RenderConfig
from blinkgl.render.antialiasing import samples_of
from blinkgl.render.contours import CROSSING, LINE, Lines
from blinkgl.render.mesh_edges import WELD, Contour, _welded
from blinkgl.render.passes import Luminance, filtered
from blinkgl.render.renderer import Renderer
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Light, Material, Part, SceneObject, Texture
from blinkgl.tools.shader_debugger.filters import _Line, filtered as filtered_slowly
from render_scenes import (
    LEVEL,
    SECOND,
    cube,
    drift,
    mesh,
    mixed_scene,
    quad,
    rig,
    scene,
    sphere,
    still,
    thing,
)
from test_antialiasing import half_plane

EDGES = RenderConfig(antialiasing="edges", image_antialiasing="edges")
WHITE = Material(unlit=True, both_sides=True)
GREY = replace(WHITE, base_color=(0.3,) * 3)


def luminance(gl, world, antialiasing: str, t_ns: int = 0) -> np.ndarray:
    with Renderer(gl, world, RenderConfig(antialiasing=antialiasing)) as renderer:
        return renderer.luminance(t_ns).read()


def finest(gl, world, factor: int = 16, t_ns: int = 0) -> np.ndarray:
    """By factor x factor samples a pixel."""
    camera = world.camera
    fine = world.with_camera(camera.resized(camera.width * factor, camera.height * factor))
    image = luminance(gl, fine, "none", t_ns)
    return image.reshape(camera.height, factor, camera.width, factor).mean(axis=(1, 3))


def rmse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


def polygon(corners: np.ndarray, depth: float, name: str = "card", number: int = 1, paint: Material = WHITE):
    """A fan of triangles, corners (N, 2) px of a 48 x 48 picture from its middle, in front of a camera of 48 px focal
    length that stands in the origin."""
    points = np.column_stack([np.asarray(corners, float) * depth / 48, np.full(len(corners), depth)])
    faces = [[0, k, k + 1] for k in range(1, len(points) - 1)]
    return thing(name, number, mesh(points, faces), still(), paint)


EYE = Rig.alone(PinHole(48, 48, 48, 48, 23.5, 23.5), still())


def looked_at(*things):
    return scene(list(things), EYE)


def test_a_straight_edge_is_as_bright_as_it_covers_the_pixel(gl):
    """To a 256th of a pixel, to which corners are snapped where it is drawn; in colour, too."""
    for angle in (0.0, 0.3, 1.0, 2.2, 4.0):
        for offset in (0.0, 0.21, 0.5):
            world, coverage = half_plane(angle, offset)
            with Renderer(gl, world, EDGES) as renderer:
                image, colour = renderer.luminance(0).read(), renderer.colour(0).read()
            np.testing.assert_allclose(image, coverage, atol=2e-3)
            np.testing.assert_allclose(colour, np.repeat(image[..., None], 3, axis=2), atol=1e-6)


@pytest.mark.parametrize("corners", [3, 4, 7])
def test_corners_and_ends_of_lines(gl, corners):
    """A polygon of any number of corners: every pixel, those with corners in them included."""
    angles = 0.37 + 2 * np.pi * np.arange(corners) / corners
    world = looked_at(polygon(15.3 * np.column_stack([np.cos(angles), np.sin(angles)]) + (0.2, -0.4), 3.0))
    true, image = finest(gl, world), luminance(gl, world, "edges")
    assert np.abs(image - true).max() < 0.02
    assert image.sum() == pytest.approx(true.sum(), rel=1e-3)


def test_a_surface_narrower_than_a_pixel(gl):
    """A wire of 0.6 px: its two edges are in the same pixels, and their changes add up."""
    for turn in (0.1, 0.5, 1.2):
        along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        sides = [along * a * 40 + across * b * 0.3 for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        world = looked_at(polygon(np.array(sides), 3.0))
        true = finest(gl, world)
        error = {name: rmse(luminance(gl, world, name), true) for name in ("none", "ssaa2", "edges")}
        assert error["edges"] < 0.1 * error["ssaa2"] < 0.1 * error["none"]


def test_what_is_hidden_does_not_show_through(gl):
    card = polygon(np.array([(-9.3, -7.2), (8.1, -7.9), (9.7, 8.4), (-8.8, 6.9)]), 5.0)
    wall = polygon(np.array([(-30, -30), (30, -30), (30, 30), (-30, 30)]), 3.0, "wall", 2, GREY)
    np.testing.assert_array_equal(
        luminance(gl, looked_at(card, wall), "edges"), luminance(gl, looked_at(card, wall), "none")
    )
    half = polygon(np.array([(0.3, -30), (30, -30), (30, 30), (0.3, 30)]), 3.0, "wall", 2, GREY)
    world = looked_at(card, half)
    error = np.abs(luminance(gl, world, "edges") - finest(gl, world))
    assert error.max() < 0.1 and (error > 0.02).sum() <= 5  # where three surfaces meet in a pixel


def slabs():
    """Six stacks of seven slabs of 1.4 px that run into each other, as parts of small models do: 0.1 to 0.8 before
    0.3."""
    rng, things = np.random.default_rng(1), []
    for k in range(42):
        turned = Rotation.from_euler("xyz", 40 * np.sin(k // 7 + np.arange(3)), degrees=True)
        place = np.array(((k // 7 % 3 - 1) * 0.9, k // 21 * 1.2 - 0.6, 3.0)) + turned.apply((0, 0.065 * (k % 7 - 3), 0))
        wide, deep = rng.uniform(0.3, 0.7, 2)
        shape = mesh(cube(0.5).vertices * (wide, 0.085, deep), cube(0.5).faces, cube(0.5).normals)
        paint = Material(base_color=((0.8, 0.1, 0.8, 0.1, 0.45, 0.8, 0.1)[k % 7],) * 3, unlit=True)
        things.append(thing(f"slab{k}", 10 + k, shape, still(place, turned), paint))
    return scene(things, EYE, background=0.3)


def specks():
    """Triangles of a tenth of a pixel, a thousand of them in one place, coincident faces, and lines of no length."""
    rng, things = np.random.default_rng(2), []
    corner = lambda size: rng.normal(0, size, (3, 2))
    for k in range(60):
        paint = replace(WHITE, base_color=(rng.choice((0.1, 0.45, 0.8)),) * 3)
        things.append(polygon(rng.uniform(-20, 20, 2) + corner(0.1), 3.0 + 0.01 * k, f"speck{k}", 10 + k, paint))
        things.append(polygon(rng.uniform(-20, 20, 2) + corner(3.0), 4.0, f"flat{k}", 100 + k, paint))
    points = np.column_stack([rng.normal(0, 0.02, (3000, 2)), np.full(3000, 3.0)])
    points[::30] = points[1::30]  # faces with two corners in one place
    paint = replace(WHITE, base_color=(0.8,) * 3)
    things.append(thing("heap", 9, mesh(points, np.arange(3000).reshape(-1, 3)), still(), paint))
    return scene(things, EYE, background=0.3)


@pytest.mark.parametrize("world", [slabs, specks], ids=lambda world: world.__name__)
@pytest.mark.parametrize("antialiasing", ["edges", "edges2"])
def test_no_value_comes_from_nowhere(gl, world, antialiasing):
    """A filtered pixel lies between the least and the largest value of the surfaces around it."""
    image, fine = luminance(gl, world(), antialiasing), finest(gl, world(), 8)
    assert np.isfinite(image).all() and image.min() > 0.1 - 1e-5 and image.max() < 0.8 + 1e-5
    # Far from the objects it is the background; but for specks between 8 x 8 samples.
    empty = ndimage.maximum_filter(np.abs(fine - 0.3), 5) < 1e-6
    assert empty.any() and np.abs(image[empty] - 0.3).max() < 0.01


def test_stacks_of_thin_slabs(gl):
    """Three and more surfaces in a pixel: the error is well below that of one sample, and there is no bias."""
    true = finest(gl, slabs())
    off = {name: luminance(gl, slabs(), name) - true for name in ("none", "edges")}
    assert rmse(off["edges"], 0) < 0.75 * rmse(off["none"], 0) and abs(off["edges"].mean()) < 2e-3


def test_the_horizon(gl):
    """Where a floor ends, a pixel in front of the line is nearer by more than a half."""
    floor = thing("floor", 2, quad(400, 400, 4), still((0, 10, -1.0)), GREY)
    world = scene([floor], rig(80, 60, 75.0))
    true = finest(gl, world, 8)
    error = {name: rmse(luminance(gl, world, name), true) for name in ("ssaa2", "edges")}
    assert error["edges"] < 0.5 * error["ssaa2"]


@pytest.mark.parametrize("crack", [0.0, 1e-3], ids=["exact", "of a file compressed part by part"])
def test_where_parts_of_one_object_meet_is_no_border(gl, crack):
    """A window in a door, and the strip beside it: every line between two parts once, not once for each of them."""
    ring = [(-15.2, -11.3), (14.1, -12.6), (16.3, 10.2), (-13.4, 12.7)]
    pane = [(-6.3, -5.1), (5.2, -6.7), (7.4, 4.9), (-5.5, 6.2)]
    frame = mesh(
        np.column_stack([np.array(ring + pane) * 3 / 48, np.full(8, 3.0)]),
        [f for k in range(4) for f in ([k, (k + 1) % 4, 4 + (k + 1) % 4], [k, 4 + (k + 1) % 4, 4 + k])],
    )
    glass = mesh(np.column_stack([np.array(pane) * 3 / 48 + crack, np.full(4, 3.0 + crack)]), [[0, 1, 2], [0, 2, 3]])
    door = SceneObject("door", 1, (Part(frame, WHITE), Part(glass, GREY)), still())
    world = looked_at(door)
    error = np.abs(luminance(gl, world, "edges") - finest(gl, world))
    assert (error > 0.02).sum() <= 4 and error.mean() < 4e-4  # the pane's corners
    contour = Contour([(frame, True), (glass, True)])
    assert (contour.edges[:, 3] < 0).sum() == 4  # the outline alone


def test_many_parts_that_meet_in_corners_have_one_outline():
    tile = quad(0.5, 0.5, 3)
    jitter = np.random.default_rng(0).uniform(-1e-3, 1e-3, (64, 3))  # of 8: cracks between the tiles
    place = lambda k: tile.vertices + (k % 8, k // 8, 0) + jitter[k]
    parts = [(mesh(place(k), tile.faces, tile.normals, tile.uvs), False) for k in range(64)]
    assert (Contour(parts).edges[:, 3] < 0).sum() == 4 * 8 * 3


def test_a_bent_surface_that_is_lit_as_if_it_were_round_has_no_creases():
    assert not Contour([(sphere(1.0, 1), False)]).sharp.any()  # 80 faces, 30 degrees and more between them


def test_creases(gl):
    """The edges of a cube that does not end there: two sides in different light."""
    turned = Rotation.from_euler("xyz", (20, 35, 10), degrees=True)
    world = scene([thing("box", 1, cube(0.7), still((0, 4, 0), turned))], rig(80, 60, 75.0), Light(sun=1.0, sky=0.2))
    true = finest(gl, world)
    error = {name: np.abs(luminance(gl, world, name) - true) for name in ("none", "ssaa2", "edges")}
    inside = np.s_[14:26, 36:54]  # along a crease, away from the silhouette's corners
    assert error["edges"][inside].max() < 0.03 < error["ssaa2"][inside].max()
    assert rmse(error["edges"], 0) < 0.7 * rmse(error["ssaa2"], 0)


def test_a_scene_of_everything_is_nearer_to_the_finest_than_with_four_samples(gl):
    """Textures, spheres, cubes, a ground, moving camera and bodies."""
    world, t = mixed_scene(), SECOND // 3
    true = finest(gl, world, 8, t)
    error = {
        name: rmse(np.log(luminance(gl, world, name, t) + 0.01), np.log(true + 0.01))
        for name in ("none", "ssaa2", "edges")
    }
    assert error["edges"] < 0.6 * error["ssaa2"] < 0.6 * error["none"]


def test_the_same_bits_by_any_renderer_and_after_any_other_frame(gl):
    world = mixed_scene()
    with Renderer(gl, world, EDGES) as one, Renderer(gl, world, EDGES) as other:
        other.luminance(0).read()
        other.colour(SECOND // 2).read()
        for t in (SECOND // 7, SECOND // 2):
            np.testing.assert_array_equal(one.luminance(t).read(), other.luminance(t).read())


# ---- lines -------------------------------------------------------------------------------------------------------


def lines_of(gl, world, t_ns: int = 0) -> np.ndarray:
    """(lines, LINE)."""
    with Renderer(gl, world, EDGES) as renderer:
        moment = renderer.moment(t_ns)
        return Lines().of(moment, moment.visible, renderer.width, renderer.height).copy()


@pytest.mark.parametrize("turn, silhouette, creases", [((0, 0, 0), 4, 0), ((0, 0, 30), 6, 1), ((25, 10, 30), 6, 3)])
def test_lines_of_a_cube(gl, turn, silhouette, creases):
    world = scene([thing("box", 1, cube(0.5), still((0, 4, 0), Rotation.from_euler("xyz", turn, degrees=True)))])
    found = lines_of(gl, world)
    assert found.shape[1] == LINE
    assert ((found[:, 6] == 0).sum(), (found[:, 6] == 1).sum()) == (silhouette, creases)


def test_three_faces_at_an_edge_and_faces_without_area():
    """The third has a border there; a triangle whose corners are one place has no edges."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, 0]], float)
    contour = Contour([(mesh(points, [[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 5, 0]]), False)])
    at = contour.edges[(np.sort(contour.edges[:, :2], axis=1) == np.sort(contour.faces[0, :2])).all(axis=1)]
    assert sorted(at[:, 3] >= 0) == [False, True]
    assert (contour.edges[:, 0] != contour.edges[:, 1]).all()


def test_lines_end_at_the_near_plane_and_beside_the_picture(gl):
    """A card from behind the camera to far ahead: all that is left is in front and within a pixel of the picture."""
    card = mesh([[-1, -5, -0.5], [1, -5, -0.5], [1, 50, -0.5], [-1, 50, -0.5]], [[0, 1, 2], [0, 2, 3]])
    found = lines_of(gl, scene([thing("card", 1, card, still(), WHITE)]))
    x, y, depth = found[:, [0, 3]], found[:, [1, 4]], found[:, [2, 5]]
    assert len(found) == 3 and np.isfinite(found).all()
    assert ((x >= -1.01) & (x <= 161.01) & (y >= -1.01) & (y <= 121.01) & (depth > 0) & (depth <= 1)).all()


def clipped(line: np.ndarray, x: int, y: int) -> tuple[float, float, float, float] | None:
    """(begin, end, room, depth) of a line in a pixel's square, by clipping it; None where it is not in it."""
    a, b = line[:2] - (x + 0.5, y + 0.5), line[3:5] - (x + 0.5, y + 0.5)
    low, high, way = 0.0, 1.0, b - a
    for k in (0, 1):
        if way[k]:
            first, last = sorted(((-0.5 - a[k]) / way[k], (0.5 - a[k]) / way[k]))
            low, high = max(low, first), min(high, last)
        elif abs(a[k]) > 0.5:
            return None
    if not low < high - 1e-9:
        return None
    p, q = a + low * way, a + high * way
    left = np.array([-way[1], way[0]]) / np.hypot(*way)
    depth = line[2] + 0.5 * (low + high) * (line[5] - line[2])
    along = way / np.hypot(*way)
    return float(along @ p), float(along @ q), -float(left @ a), depth


def test_lines_are_cut_where_they_pass_from_pixel_to_pixel(gl):
    """Against clipping every line by every pixel; each pixel is there once, its lines in their order."""
    world, t = mixed_scene(40, 30), SECOND // 3
    with Renderer(gl, world, EDGES) as renderer:
        lines, moment = Lines(), renderer.moment(t)
        for _ in range(2):  # nothing is left of the time before
            pixels, crossings = lines.in_pixels(moment, moment.visible, 40, 30)
        whole = lines.of(moment, moment.visible, 40, 30)
    assert crossings.shape[1] == CROSSING and len({(x, y) for x, y, *_ in pixels.tolist()}) == len(pixels) > 100
    found = {(x, y): crossings[first:end] for x, y, first, end in pixels.tolist()}
    seen = 0
    for y in range(30):
        for x in range(40):
            true = [c for line in whole if (c := clipped(line, x, y)) is not None]
            mine = found.get((x, y), np.empty((0, CROSSING)))
            assert len(mine) == len(true)
            if true:
                np.testing.assert_allclose(mine[:, :4], true, atol=1e-5)
            seen += len(true)
    assert seen == len(crossings)


def test_shares_add_up_to_areas(gl):
    """Of a closed outline the shares in each pixel are its area there, less what the centre shows."""
    angles = 0.37 + 2 * np.pi * np.arange(5) / 5
    corners = 15.3 * np.column_stack([np.cos(angles), np.sin(angles)]) + (0.2, -0.4)
    world = looked_at(polygon(corners, 3.0))
    true, centres = finest(gl, world, 32), luminance(gl, world, "none")
    with Renderer(gl, world, EDGES) as renderer:
        moment = renderer.moment(0)
        pixels, crossings = Lines().in_pixels(moment, moment.visible, 48, 48)
    for x, y, first, end in pixels.tolist():
        shares = [_Line(*c[:3], c[4:6]).share_and_turn()[0] for c in crossings[first:end].astype(float)]
        assert abs(centres[y, x] + sum(shares) - true[y, x]) < 0.02


def zigzag(depth: float):
    """Wires of 0.2 px at many angles, and a crumpled ball of triangles smaller than a pixel."""
    wires = []
    for k in range(8):
        along = np.array([np.cos(0.4 * k + 0.1), np.sin(0.4 * k + 0.1)])
        across = 0.1 * np.array([-along[1], along[0]])
        ends = [along * a * (6 + 2 * k) + across * b for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        wires.append(polygon(np.array(ends) + (k - 4, 3 - k), depth + 0.1 * k, f"wire{k}", 10 + k))
    return wires


def aligned():
    """Cards whose edges run through pixels' centres, some of them before a wall that they nearly touch."""
    card = lambda x, y, size, depth, k: polygon(
        np.array([(x, y), (x + size, y), (x + size, y + size), (x, y + size)]), depth, f"card{k}", 10 + k, paints[k % 3]
    )
    paints = [replace(WHITE, base_color=(c,) * 3) for c in (1.0, 0.1, 0.6)]
    wall = polygon(30 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]), 3.0, "wall", 2, GREY)
    places = [(-18.5, -15.5, 8), (-4.5, -12.5, 9), (6.5, 3.5, 5), (-14.5, 2.5, 11), (0.5, 6.5, 3)]
    return looked_at(wall, *(card(x, y, size, 2.999 - 0.3 * (k % 2), k) for k, (x, y, size) in enumerate(places)))


def folded():
    """A strip that is folded within a pixel: three layers of it, over and over."""
    x = np.concatenate([[0.0, 0.45, 0.05, 0.5, 0.1] + np.full(5, 6.0 * k) for k in range(-3, 3)])
    corners = [(a * 0.0625, b * 0.0625, 3.0 - 0.002 * (k % 5)) for k, a in enumerate(x) for b in (-18.0, 18.0)]
    faces = []
    for k in range(len(x) - 1):
        if k % 5 != 4:
            faces += [[2 * k, 2 * k + 1, 2 * k + 2], [2 * k + 1, 2 * k + 3, 2 * k + 2]]
    wall = polygon(30 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]), 6.0, "wall", 2, GREY)
    return looked_at(wall, thing("strip", 3, mesh(np.array(corners), faces), still(), WHITE))


def horizon():
    return scene([thing("floor", 2, quad(400, 400, 4), still((0, 10, -1.0)), GREY)], rig(80, 60, 75.0))


def cards():
    rng = np.random.default_rng(4)
    return looked_at(
        *(
            polygon(rng.uniform(-18, 18, 2) + rng.normal(0, 5, (3, 2)), 3 + 0.005 * k, f"card{k}", k + 1, paint)
            for k, paint in enumerate(replace(WHITE, base_color=(c,) * 3) for c in rng.uniform(0, 2, 40).tolist())
        )
    )


def wires():
    wall = polygon(30 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]), 6, "w", 2, GREY)
    return looked_at(*zigzag(3.0), wall)


def snapped():
    """Cards whose edges end 1/150 px before or behind pixels' centres, which narrower cards cover or leave free."""
    wall = polygon(30 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]), 6.0, "wall", 2, GREY)
    box = lambda x, y, w, h, k: polygon(
        np.array([(x, y), (x + w, y), (x + w, y + h), (x, y + h)]), 3.0, f"c{k}", 10 + k
    )
    things, k = [], 0
    for row, off in enumerate((-1 / 150, 1 / 150)):
        for column in range(4):
            x, y = -17.5 + 9 * column, -18.3 + 17 * row
            things += [box(x - 4, y, 4 + off, 14, k), box(x - 0.3, y + 4, 0.7, 6, k + 1)]
            k += 2
    return looked_at(wall, *things)


def posts():
    """A floor that ends at a sloping horizon, and posts before it, two to twenty times as near as its end."""
    turn = Rotation.from_euler("y", 5, degrees=True)
    things = [thing("floor", 2, quad(400, 400, 4), still((0, 10, -1.0), turn), GREY)]
    for k, near in enumerate((1.6, 2.0, 2.2, 2.4, 2.6, 3.0, 4.0, 8.0)):
        away = 75 / near
        x = (8 * k - 28.3) * away / 75
        card = mesh(
            [
                (x, away, -0.2 * away),
                (x + 0.03 * away, away, -0.2 * away),
                (x + 0.03 * away, away, 0.3 * away),
                (x, away, 0.3 * away),
            ],
            [[0, 1, 2], [0, 2, 3]],
        )
        things.append(thing(f"post{k}", 10 + k, card, still(), replace(WHITE, base_color=(0.2 + 0.8 * (k % 2),) * 3)))
    return scene(things, rig(80, 60, 75.0))


def chamfered():
    """Corners of boxes with three chamfers of a fiftieth of a pixel, a little out of the upright."""
    things = []
    for k in range(4):
        ways = np.deg2rad([-45, -22.5, 0, 22.5, 45])  # of the five sides, from the camera's axis
        sizes = np.array([6.0, 0.02, 0.02, 0.02, 6.0])
        steps = np.column_stack([np.cos(ways), np.sin(ways)]) * sizes[:, None]
        corners = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]) - (steps.sum(axis=0) / 2)
        points, faces, normals = [], [], []
        for (x0, z0), (x1, z1), way in zip(corners[:-1], corners[1:], ways):
            first = len(points)
            points += [(x0, -20, z0), (x1, -20, z1), (x1 + 0.7, 20, z1), (x0 + 0.7, 20, z0)]
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
            normals += 4 * [(np.sin(way), 0, -np.cos(way))]
        shape = mesh(np.array(points) / 16, faces, np.array(normals))
        paint = Material(both_sides=True)
        things.append(thing(f"box{k}", 10 + k, shape, still(((k * 11 - 16.3) / 16, 0, 3.0)), paint))
    return scene(things, EYE, Light(sun=1.0, sky=0.2))


WORLDS = {
    "everything": mixed_scene,
    "wires": wires,
    "rough": lambda: rough_ball(4, 0.04),
    "cards": cards,
    "aligned": aligned,
    "folded": folded,
    "horizon": horizon,
    "snapped": snapped,
    "posts": posts,
    "chamfered": chamfered,
    "slabs": slabs,
    "specks": specks,
}


def filtered_twice(gl, world, t_ns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(unfiltered, filtered by the program, by its slow twin from the same picture, depths and lines)."""
    with Renderer(gl, world, EDGES) as renderer:
        plain = renderer.draw(Luminance(samples_of("edges")), t_ns)
        picture, depths = plain.read(), plain.target.read_depth()
        moment = renderer.moment(t_ns)
        pixels, crossings = Lines().in_pixels(moment, moment.visible, renderer.width, renderer.height)
        focal = 0.5 * renderer.width * abs(moment.view.projection[0, 0])
        written = renderer.draw(filtered(Luminance(samples_of("edges"))), t_ns).read()
        return picture, written, filtered_slowly(picture, depths, pixels, crossings, 1 / focal, written)


@pytest.mark.parametrize("world", WORLDS)
def test_the_program_does_what_its_slow_twin_does(gl, world):
    """In float64, a pixel at a time, from the same picture, depths and lines."""
    picture, image, twin = filtered_twice(gl, WORLDS[world](), SECOND // 3)
    assert (np.abs(twin - picture) > 0.01).sum() > 50
    np.testing.assert_allclose(image, twin, atol=2e-4 * picture.mean(), rtol=2e-4)


def test_through_a_lens(gl):
    """The lines are those of the flat picture, which the lens's is a mean of."""
    world = mixed_scene(80, 60)
    lens = Radtan(80, 60, 75.0, 75.0, 39.5, 29.5, k1=-0.2, k2=0.05)
    seen = world.with_camera(lens)
    true, plain, edged, finer = (
        luminance(gl, seen, name, SECOND // 3) for name in ("ssaa4", "none", "edges", "edges2")
    )
    assert rmse(edged, true) < 0.8 * rmse(plain, true) and rmse(finer, true) < 0.7 * rmse(edged, true)


# ---- triangles smaller than a pixel --------------------------------------------------------------------------------


def rough_ball(subdivisions: int, dents: float):
    """A ball of 14 px whose outline runs to and fro where its triangles are small."""
    ball = sphere(1.0, subdivisions)
    points, place = np.unique(np.round(ball.vertices, 6), axis=0, return_inverse=True)
    rough = 1 + dents * np.random.default_rng(3).uniform(-1, 1, len(points))
    shape = mesh(ball.vertices * rough[place.reshape(-1), None], ball.faces)
    paint = replace(WHITE, both_sides=False)
    return scene([thing("ball", 1, shape, drift((0, 3.4, 0), (0.4, 0, 0.1), LEVEL), paint)], rig(48, 48, 48.0))


def test_seams_of_textures(gl):
    """Two halves of a card that show different places of their texture, along a zigzag of half pixels."""
    rows = 40
    y = np.linspace(-10, 10, rows)
    middle = 0.3 * (-1.0) ** np.arange(rows)
    points = np.concatenate([np.column_stack([x * np.ones(rows), y]) for x in (-8 + 0 * middle, middle, middle, 8)])
    uvs = np.concatenate([np.full((2 * rows, 2), 0.25), np.full((2 * rows, 2), 0.75)]).astype(np.float32)
    k = np.arange(rows - 1)
    strip = lambda a: np.concatenate(
        [
            np.column_stack([a + k, a + rows + k, a + k + 1]),
            np.column_stack([a + rows + k, a + rows + k + 1, a + k + 1]),
        ]
    )
    card = mesh(np.column_stack([points * 3 / 48, np.full(4 * rows, 3.0)]), np.concatenate([strip(0), strip(2 * rows)]))
    image = np.zeros((64, 64, 3), np.float32)
    image[:32], image[32:] = 0.1, 0.9
    paint = Material(Texture(image), unlit=True, both_sides=True)
    world = looked_at(thing("card", 1, replace(card, uvs=uvs), still(), paint))
    assert set(Contour([(world.objects[0].parts[0].mesh, False)]).sharp.tolist()) == {0, 2}
    true = finest(gl, world)
    inside = np.s_[16:32, 20:28]
    error = {name: rmse(luminance(gl, world, name)[inside], true[inside]) for name in ("taps4", "edges")}
    assert error["edges"] < 0.5 * error["taps4"]


@pytest.mark.parametrize("subdivisions, dents", [(4, 0.01), (5, 0.005)])
def test_small_triangles_do_not_flicker(gl, subdivisions, dents):
    """All lines of a pixel mean the same two surfaces, whichever way they run: an outline of steps of 0.7 and 0.35 px
    has about the error of a smooth one, and no more of it changes from frame to frame when frames come closer."""
    world = rough_ball(subdivisions, dents)
    times = [int(k * (SECOND // 40)) for k in range(5)]  # a seventh of a pixel each
    true = np.stack([finest(gl, world, 8, t) for t in times])
    off = {name: np.stack([luminance(gl, world, name, t) for t in times]) - true for name in ("none", "edges")}
    assert rmse(off["edges"], 0) < 0.45 * rmse(off["none"], 0)
    for step in (1, 2):
        change = {name: rmse(np.diff(error[::step], axis=0), 0) for name, error in off.items()}
        assert change["edges"] < 0.45 * change["none"]


def test_places_in_a_chain_of_three_parts_are_one():
    """Each end is the middle's nearest, and the ends are no neighbours: the order of the parts does not matter."""
    off = 0.7 * WELD
    for order in itertools.permutations(range(3)):
        places = np.concatenate([np.array([[k * off, 0, 0]]) for k in order] + [[[1.0, 0, 0]]])
        joined = _welded(places, [np.array([0]), np.array([1]), np.array([2])])
        assert joined.tolist() == [0, 0, 0, 3], order
