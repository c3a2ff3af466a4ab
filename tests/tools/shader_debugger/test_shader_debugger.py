"""passes, probe and diff: what they show is what generation renders, and broken shaders are found."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from debugger_scene import HEIGHT, LOOKUP_MISTAKES, MISTAKES, WIDTH, edit
from scipy.spatial.transform import Rotation

from blinkgl.camera import PinHole
from blinkgl.config.run import load_run
from blinkgl.gl import create_context
from blinkgl.labels import LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import build_scene
from blinkgl.tools.shader_debugger import compare, filters, mipmaps, moments, probe, quantities
from blinkgl.tools.shader_debugger.session import moment, open_renderer, open_subject

T, T_NEXT, T_LAST = 100_000_000, 200_000_000, 0


@pytest.fixture(scope="module")
def world(config):
    one = load_run(config).sequence(0)
    return one, build_scene(one.scene, one.camera, one.time.t0_ns, one.time.t1_ns, seed=one.seed)


@pytest.fixture(scope="module")
def written(config, tmp_path_factory):
    from blinkgl import cli

    out = tmp_path_factory.mktemp("passes")
    assert cli.run(["shader", "passes", config, "--out", str(out)]) == 0
    return out


# ------------------------------------------------------------------------------------------------- passes


def test_passes_writes_every_buffer_that_generation_renders(written, world):
    config, scene = world
    arrays = {name: np.load(written / f"{name}.npy") for name in moments.buffers_of(scene)}
    ask = LabelRequest(
        "depth",
        "ids",
        "normals",
        "velocity",
        "flow_forward",
        "flow_backward",
        "occlusion_forward",
        "occlusion_backward",
    )
    with create_context() as gl, Renderer(gl, scene, config.render) as renderer:
        labels = renderer.labels(T, ask, T_NEXT, T_LAST)
        luminance, colour = renderer.luminance(T).read(), renderer.colour(T).read()
    for name, expected in {
        "luminance": luminance,
        "colour": colour,
        "depth": labels.depth,
        "id": labels.ids,
        "normals": labels.normals,
        "velocity": labels.velocity,
        "flow_forward": labels.forward.flow,
        "valid_forward": labels.forward.valid,
        "occluded_forward": labels.forward.occluded,
        "flow_backward": labels.backward.flow,
        "valid_backward": labels.backward.valid,
        "occluded_backward": labels.backward.occluded,
    }.items():
        assert arrays[name].dtype == expected.dtype, name
        np.testing.assert_array_equal(arrays[name], expected, err_msg=name)
    assert arrays["luminance_uv"].shape == (HEIGHT, WIDTH, 2) and arrays["colour_level"].shape == (HEIGHT, WIDTH)
    assert not arrays["valid_forward"][labels.ids == 4].any() and (labels.ids == 4).any()  # the pane passes the camera


# ------------------------------------------------------------------------------------------------- against the
# reference


@pytest.fixture(scope="module")
def both(config):
    subject = open_subject(config)
    when = moment(subject)
    with open_renderer(subject) as renderer:
        gpu, ref = (
            moments.GpuMoment(renderer, when),
            moments.ReferenceMoment(subject.scene, when, subject.config.render.mip_bias),
        )
        for name in (*moments.buffers_of(subject.scene), "part", "window", "next_depth_forward", "next_depth_backward"):
            gpu[name]
        comparison = compare.Comparison(gpu, ref)
        reports = {name: comparison.report(name) for name in comparison.names()}
        yield gpu, ref, comparison, reports


def test_every_buffer_agrees(both):
    gpu, _, _, reports = both
    assert set(reports) == set(quantities.QUANTITIES) & set(moments.buffers_of(both[1].scene, gpu.renderer.filtered))
    assert gpu.renderer.filtered == ("luminance_edges",)  # of the default
    for name, report in reports.items():
        assert report.passed, (name, report.value)
        assert report.graded.mean() > 0.8, name
    assert np.ptp(gpu["luminance_level"]) > 3


def test_look_ups_are_those_of_the_pass_itself(both):
    """The variant that shows them writes the very picture of the pass, and what it shows makes that picture."""
    gpu, ref, _, _ = both
    gpu.renderer.gl.make_current()
    hit, textured = gpu["id"] != 0, ref["texture_size"][..., 0] > 1
    for name in ("luminance", "colour"):
        shown = gpu.renderer.lookups(name, T)
        np.testing.assert_array_equal(shown["result"], gpu[name])
        product = gpu[f"{name}_albedo"] * gpu[f"{name}_light"][..., None]
        np.testing.assert_allclose((product if name == "colour" else product[..., 0])[hit], gpu[name][hit], rtol=1e-6)
        np.testing.assert_array_equal(gpu[f"{name}_count"][hit], textured[hit].astype(np.float32))
    np.testing.assert_array_equal(gpu["luminance_uv"], gpu["colour_uv"])


@pytest.mark.parametrize("angle, beside", [(0, 0.0), (45, 0.5)])
def test_mip_levels_of_a_facing_plane(angle, beside):
    """texels per px = texels per unit * Z / f; the axes of a texture that is turned are both shorter and longer."""
    focal, depth, per_unit = 120.0, 4.0, 64.0
    points = np.array([[[-1, -1, depth], [1, -1, depth], [0, 1.5, depth]]])
    turn = Rotation.from_euler("z", angle, degrees=True).as_matrix()[:2, :2]
    camera, pixel = PinHole(64, 48, focal, focal, 31.5, 23.5), np.array([[40, 20]])
    low, usual, high = mipmaps.levels(points, points[..., :2] @ turn * per_unit, pixel, camera)[0]
    assert usual == pytest.approx(np.log2(per_unit * depth / focal), abs=1e-9)
    assert (usual - low, high - usual) == pytest.approx((beside, 1 - beside), abs=1e-9)


def test_a_mip_level_beside_the_horizon_is_anything():
    """The plane y = 1, seen at eye level: of a quad's two rows one looks past its end."""
    points = np.array([[[-1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 50.0]]])
    levels = mipmaps.levels(points, points[..., ::2], np.array([[3, 4]]), PinHole(8, 8, 10.0, 10.0, 3.5, 4.5))
    assert levels.tolist() == [[-np.inf, np.inf, np.inf]]


# ------------------------------------------------------------------------------------------------- edges


ALL_EDGED = ("--set", "render.image_antialiasing=edges")
BOTH = ("--pass", "luminance_edges", "--pass", "colour_edges")


def test_what_edges_puts_together_is_what_its_reference_does(shader, config, tmp_path):
    """In luminance and colour, at all pixels, silhouettes first of all."""
    out = tmp_path / "d"
    status, text, _ = shader("diff", config, *ALL_EDGED, *BOTH, "--time", 0.1, "--json", "--out", out)
    reports = json.loads(text)["buffers"]
    assert status == 0 and [r["buffer"] for r in reports] == list(filters.EDGED)
    for report in reports:
        assert report["passed"] and report["value"] < 1e-5 and report["tolerance"] == 1e-4
        assert report["off_silhouettes"]["pixels"] == WIDTH * HEIGHT
    assert np.load(out / "luminance_edges_error.npy").shape == (HEIGHT, WIDTH) and (out / "diff.png").exists()
    status, text, _ = shader("diff", config, *BOTH[:2], "--tolerance", "0")
    assert status == 1 and "FAIL luminance_edges" in text  # float32


def test_a_mistake_in_edges_is_named_and_can_be_probed(shader, config, shaders):
    edit(shaders / "edges.glsl", "light.OF = result", "light.OF = plain")
    names = ("--pass", "depth", "--pass", "luminance_edges")
    status, out, _ = shader("diff", config, "--shaders", shaders, *names)
    lines = out.splitlines()
    assert status == 1 and lines[0].startswith("The first that is wrong: luminance, edges (edges.glsl), on ")
    assert "it looks as if: nothing is filtered: the picture is the unfiltered one" in lines[1]
    pixel = re.search(r"1 of 2 buffers are over their tolerance; look closer with: probe --pixel (\d+,\d+)", out)[1]
    status, out, _ = shader("probe", config, "--shaders", shaders, "--pixel", pixel)
    assert status == 0 and any(line.startswith("!! luminance, edges") for line in out.splitlines())


# ------------------------------------------------------------------------------------------------- probe


FILTERED = ("colour", "luminance", "luminance_edges")


def test_probe_shows_the_values_of_passes(shader, config, written):
    x, y = 35, 40
    status, out, _ = shader("probe", config, "--time", 0.1, "--pixel", f"{x},{y}", "--json")
    found = json.loads(out)
    assert status == 0 and found["pixel"] == [x, y]
    for row in found["buffers"]:
        if row["name"] not in FILTERED:  # passes filters them, as generation does
            np.testing.assert_array_equal(
                np.asarray(row["gpu"]), np.load(written / f"{row['name']}.npy")[y, x], err_msg=row["name"]
            )
    by_name = {row["name"]: row for row in found["buffers"]}
    assert (
        by_name["depth"]["ulps"] < 8
        and by_name["flow_forward"]["error"] < 1e-5
        and by_name["flow_forward"]["error_unit"] == "px"
    )
    assert found["surface"]["gpu"]["object"] == found["surface"]["reference"]["object"] == "ball"
    bary = found["surface"]["reference"]["bary"]
    np.testing.assert_allclose(found["surface"]["gpu"]["bary"], bary, atol=1e-3)
    assert sum(bary) == pytest.approx(1) and min(bary) >= 0
    for row in found["positions"]:
        if row["gpu"] is not None:
            np.testing.assert_allclose(row["gpu"], row["reference"], atol=1e-4)


def test_probe_says_why(both, config, shader):
    gpu, ref, comparison, _ = both
    clear = ~comparison.band
    flow = ref.frame.forward
    hidden = clear & ref["occluded_forward"] & ~flow.outside & gpu["occluded_forward"]
    cases = {
        "behind the camera at t'": clear & (ref["id"] == 4),
        "hidden at t'": hidden & (flow.hidden_by[..., 0] == 2) & (gpu["id"] == 2),
        "outside the image at t'": clear & flow.outside & gpu["occluded_forward"],
        "nothing hit": clear & ~ref.frame.hit,
        "": clear & ref["valid_forward"] & ~ref["occluded_forward"] & ~gpu["occluded_forward"],
    }
    for words, mask in cases.items():
        assert mask.any(), words
        gpu.renderer.gl.make_current()  # the commands of other tests had contexts of their own
        y, x = np.argwhere(mask)[mask.sum() // 2]
        found = probe.probe(gpu, ref, int(x), int(y), comparison)
        for side in ("gpu", "reference"):
            why = found["why"]["forward"][side]
            assert why.startswith(words) and bool(why) == bool(words), (side, why)
        if words == "hidden at t'":
            assert "box" in found["why"]["forward"]["gpu"] and "box" in found["why"]["forward"]["reference"]
            status, out, _ = shader("probe", config, "--pixel", f"{x},{y}")
            assert status == 0 and "forward   reference  hidden at t' by box" in out


# ------------------------------------------------------------------------------------------------- diff, and the
# mistakes


def test_diff_of_the_shipped_shaders_is_clean(shader, config, tmp_path):
    some = ("--pass", "depth", "--pass", "flow_forward", "--pass", "luminance")
    status, out, _ = shader("diff", config, "--time", 0.1, *some, "--out", tmp_path / "d")
    assert (
        status == 0
        and "all 3 buffers agree" in out
        and "silhouette band" in out
        and "own albedo times its own light" in out
    )
    assert (tmp_path / "d" / "diff.png").stat().st_size > 10_000
    assert np.load(tmp_path / "d" / "depth_error.npy").shape == (HEIGHT, WIDTH)


EXPECTED = {
    "sign of the flow": ("flow_forward", "the sign is wrong", "forward flow"),
    "no perspective division": ("flow_forward", "the perspective division is missing", "forward flow"),
    "depth off by near": ("depth", "near = 0.05 is subtracted from the depth", "depth"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_broken_shader_is_found(shader, config, shaders, mistake):
    file, right, wrong = MISTAKES[mistake]
    edit(shaders / file, right, wrong)
    buffer, suspicion, title = EXPECTED[mistake]
    status, out, _ = shader("diff", config, "--shaders", shaders, "--json")
    reports = {b["buffer"]: b for b in json.loads(out)["buffers"]}
    assert status == 1 and not reports[buffer]["passed"]
    assert reports[buffer]["suspicions"][0].startswith(suspicion)
    unharmed = {"local", "id", "velocity", "normals", "luminance", "colour", "luminance_albedo", "colour_uv"} | (
        {"depth"} if buffer != "depth" else {"flow_forward"}
    )
    assert all(reports[name]["passed"] for name in unharmed)

    worst = reports[buffer]["objects"][0]
    status, out, _ = shader("probe", config, "--shaders", shaders, "--pixel", f"{worst['x']},{worst['y']}")
    marked = [line for line in out.splitlines() if line.startswith("!!")]
    assert status == 0 and any(line[3:].startswith(title) for line in marked)


@pytest.mark.parametrize("mistake", LOOKUP_MISTAKES)
def test_a_mistaken_look_up_is_named_as_such(shader, config, shaders, mistake):
    edits, buffer, suspicion, objects = LOOKUP_MISTAKES[mistake]
    for file, right, wrong in edits:
        edit(shaders / file, right, wrong)
    status, out, _ = shader("diff", config, "--shaders", shaders)
    lines = out.splitlines()
    assert status == 1
    assert lines[0].startswith(f"The first that is wrong: {moments.PASSES[buffer].title} (")
    assert suspicion in (lines[1] if "it looks as if: " in lines[1] else "")
    named = lines[0].partition(", on ")[2].split(", ")
    assert set(named) == objects
    for name in objects:  # one line each, with a pixel to look at
        row = [line for line in lines if line.startswith(f"  {name} ") and moments.PASSES[buffer].title in line]
        assert len(row) == 1 and re.search(r"\(\d+, \d+\)", row[0])
