"""One pixel: each buffer beside the float64 reference, the point's position in every frame of reference, and the reason
if it is invalid or occluded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from trimesh.triangles import points_to_barycentric

from blinkgl.render import casting
from blinkgl.render.passes.own import OWN
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Scene
from blinkgl.tools.shader_debugger import reference
from blinkgl.tools.shader_debugger.compare import Comparison
from blinkgl.tools.shader_debugger.filters import FILTERED
from blinkgl.tools.shader_debugger.lamps import place_in
from blinkgl.tools.shader_debugger.moments import MAPS, PASSES, GpuMoment, ReferenceMoment, buffers_of
from blinkgl.tools.shader_debugger.quantities import QUANTITIES


def ulps(gpu: np.ndarray, ref: np.ndarray) -> float:
    """Return the largest |gpu - ref| in units of float32's spacing at ref (per component); inf where one is not
    finite."""
    g, r = np.atleast_1d(np.asarray(gpu, np.float64)), np.atleast_1d(np.asarray(ref, np.float64))
    with np.errstate(all="ignore"):
        # The distance of two neighbouring float32 at the reference's value.
        apart = np.abs(g - r) / np.spacing(np.abs(r).astype(np.float32)).astype(np.float64)
    # Equal values, infinities included, have no difference; other infinities give nan.
    return float(np.where(g == r, 0.0, np.nan_to_num(apart, nan=np.inf, posinf=np.inf)).max())


def probe(gpu: GpuMoment, ref: ReferenceMoment, x: int, y: int, comparison: Comparison | None = None) -> dict:
    """Plain data (JSON) about pixel (x, y):

    buffers  : rows of name, unit, gpu, reference, error, error_unit, ulps, ok (None: not graded here), note.
    surface  : what the reference hit: object, category, instance, part, triangle, front, bary, corners …, and what the
    GPU drew. positions: rows of name, gpu, reference (4 or 3 numbers each): local, camera, world, clip, window at t and
    t', and of each shadow map where in it (texels), how deep, and what it holds there.
    why : per direction, the reference's reason and the GPU's own for invalid or occluded ("": seen at both times).
    """
    comparison = comparison or Comparison(gpu, ref)
    scene, when = ref.seen, gpu.when
    parts = casting.scene_parts(scene)
    drawn, true = int(gpu["part"][y, x]), int(ref["part"][y, x])
    # Behind a lens: the pixel of the flat picture that it reads; later results are of the lens's own ray.
    point = _hit(ref.frame, x, y)
    return {
        "pixel": [x, y],
        "t_s": when.t_ns * 1e-9,
        "times_s": {"forward": when.forward_ns * 1e-9, "backward": when.backward_ns * 1e-9},
        "band": bool(comparison.band[y, x]),
        "buffers": [
            _row(name, gpu, ref, comparison, x, y)
            for name in buffers_of(scene, gpu.renderer.filtered)
            if name not in ("triangle", "local", *MAPS)
        ],  # told below
        "surface": {
            "gpu": _surface(
                parts, drawn, int(gpu["triangle"][y, x]) - 1, _barycentric(parts, drawn, gpu, x, y, when.t_ns)
            ),
            "reference": _surface(parts, true, int(point.triangle[0]), point.bary[0]) | _seen_side(ref, point),
        },
        "positions": _positions(gpu, ref, x, y, point) if true >= 0 or drawn >= 0 else [],
        "why": {
            way: {"reference": reference.why(scene, ref.labels, way, x, y), "gpu": _gpu_reason(gpu, way, x, y)}
            for way in ("forward", "backward")
        },
    }


def _hit(frame: reference.ReferenceFrame, x: int, y: int) -> casting.Hits:
    """Return what a frame sees at one pixel."""
    k = y * frame.hit.shape[1] + x
    return casting.Hits(**{name: v if name == "t_ns" else v[k : k + 1] for name, v in vars(frame.hits()).items()})


def _seen_side(ref: ReferenceMoment, point: casting.Hits) -> dict:
    """Return whether a surface is seen from the front, and the corners of its triangle; empty where nothing is hit."""
    if not point.hit[0]:
        return {}
    mesh = casting.scene_parts(ref.scene)[point.part[0]][1].mesh
    corners = casting.vertices_at(mesh, point.t_ns)[mesh.faces[point.triangle[0]]]
    return {"front": bool(point.front[0]), "corners": _plain(corners)}


def _placed(scene: Scene, point: casting.Hits, t_ns: int) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Return the position of a hit point at a time, in the axes of the world and of the camera."""
    if not point.hit[0]:
        return None, None
    moved = replace(point, local=casting.local_at(scene, point, t_ns))
    world = casting.applied(scene, moved, lambda thing: thing.path.pose(t_ns))
    return world[0], casting.applied(scene, moved, lambda thing: casting.relative_pose_at(scene, thing, t_ns))[0]


def _plain(values):
    return None if values is None else np.asarray(values).tolist()


def _row(name, gpu, ref, comparison, x, y) -> dict:
    unknown = name in OWN and OWN[name].reference is None
    if unknown:
        g = gpu[name][y, x]
        r = np.full_like(g, np.nan, np.float64)
    else:
        g, r = (side[y, x] for side in (comparison.pair(name) if name in FILTERED else (gpu[name], ref[name])))
    info = PASSES[name]
    exact = info.kind in ("mask", "ids")
    apart = None if exact or unknown else ulps(g, r)
    distance = float(np.linalg.norm(np.atleast_1d(g.astype(np.float64) - r))) if apart else 0.0
    row: dict[str, object] = {
        "name": name,
        "title": info.title,
        "unit": info.unit,
        "gpu": g.tolist(),
        "reference": r.tolist(),
        "error": 0.0 if unknown else float(g != r) if exact else distance,
        "error_unit": "mismatch" if exact else info.unit,
        "ulps": apart,
        "ok": None,
        "note": "the plug-in gives no reference" if unknown else "",
    }
    if name in comparison.names() and name in QUANTITIES:
        quantity = QUANTITIES[name]
        error = float(comparison.errors(name)[y, x])
        limit = quantity.tolerance if quantity.statistic == "max" else 0.5
        row["ok"] = bool(error <= limit) if comparison.graded(name)[y, x] else None
        if name in ("luminance", "colour"):
            row["note"] = (
                "of the GPU's own albedo and light: "
                f"{np.array2string(np.asarray(comparison.pair(name)[1][y, x]), precision=7)}, {error:.2g} off"
            )
    if name == "colour_albedo" and ref["level"][y, x] > 0:
        row["note"] = f"full resolution (level 0): {np.array2string(ref['albedo_level0'][y, x], precision=5)}"
    return row


def _surface(parts, p, triangle, bary) -> dict:
    if p < 0:
        return {"object": None}
    body, part = parts[p]
    return {
        "object": body.name,
        "category": body.category,
        "instance": body.instance_id,
        "part": [i for i, own in enumerate(body.parts) if own is part][0],
        "mesh": part.mesh.name,
        "texture": part.material.texture.name if part.material.texture else None,
        "triangle": triangle,
        "bary": _plain(bary),
        "both_sides": not part.culled,
        "unlit": part.material.unlit,
    }


def _barycentric(parts, p, gpu, x, y, t_ns):
    """Of the GPU's interpolated local position in the triangle it drew; None: it has no area."""
    # The GPU numbers triangles from 1 on; 0 is none.
    triangle = int(gpu["triangle"][y, x]) - 1
    if p < 0 or not 0 <= triangle < len(parts[p][1].mesh.faces):
        return None
    mesh = parts[p][1].mesh
    corners = casting.vertices_at(mesh, t_ns)[mesh.faces[triangle]]
    with np.errstate(all="ignore"):
        shares = points_to_barycentric(corners[None], gpu["local"][y, x].astype(np.float64)[None], method="cross")[0]
    return shares if np.isfinite(shares).all() else None


def _positions(gpu, ref, x, y, point) -> list[dict]:
    """Return the positions. The GPU's clip position is the one it used: gl_FragCoord at t; at t' the position and depth
    that its flow implies."""
    scene, when = ref.scene, gpu.when
    P = scene.camera.clip_from_cam()
    size = np.array([scene.camera.width, scene.camera.height], float)
    rows: list[dict] = []

    def add(name, g, r):
        rows.append({"name": name, "gpu": _plain(g), "reference": _plain(r)})

    p = int(gpu["part"][y, x])
    local = gpu["local"][y, x].astype(np.float64) if p >= 0 else None
    body = casting.scene_parts(scene)[p][0] if p >= 0 else None

    def world(t_ns):
        if body is None:
            return None
        pose = body.path.pose(t_ns)
        return pose[:3, :3] @ local + pose[:3, 3]

    true_world, true_camera = _placed(scene, point, when.t_ns)
    add("local", local, point.local[0] if point.hit[0] else None)
    add("world, t", world(when.t_ns), true_world)
    add("camera, t", None, true_camera)
    window = gpu["window"][y, x].astype(np.float64)
    # gl_FragCoord contains all of the GPU's clip position: w is 1 / Z there.
    ndc = window[:2] / size * 2 - 1
    clip = np.array([*ndc, window[2], 1.0]) / window[3] if window[3] else None
    add("clip, t", clip, None if true_camera is None else P @ [*true_camera, 1.0])
    for way, label in (("forward", "t' forward"), ("backward", "t' backward")):
        t_ns, flow = getattr(when, f"{way}_ns"), getattr(ref.labels, way)
        later_world, later_camera = _placed(ref.seen, _hit(ref.labels, x, y), t_ns)
        add(f"world, {label}", world(t_ns), later_world)
        add(f"camera, {label}", None, later_camera)
        w = float(gpu[f"next_depth_{way}"][y, x])
        there = ndc + gpu[f"flow_{way}"][y, x] * 2 / size
        add(
            f"clip, {label}",
            [there[0] * w, there[1] * w, scene.camera.near, w] if p >= 0 and scene is ref.seen else None,
            None if later_camera is None else P @ [*later_camera, 1.0],
        )
        add(
            f"pixel, {label}",
            [x, y] + gpu[f"flow_{way}"][y, x].astype(np.float64) if gpu[f"valid_{way}"][y, x] else None,
            [x, y] + flow.flow[y, x] if flow.valid[y, x] else None,
        )
    for k, one in enumerate(ref.maps):
        here = {}
        for side, moment, at in (("gpu", gpu, world(when.t_ns)), ("reference", ref, true_world)):
            there = None if at is None else place_in(one, when.t_ns, at)
            if there is not None:
                x_map, y_map = (int(np.clip(v, 0, one.texels - 1)) for v in there[:2])
                there = np.array([*there, moment[MAPS[k]][y_map, x_map]])
            here[side] = there
        add(f"{MAPS[k]}: x, y, depth; map", here["gpu"], here["reference"])
    return rows


def _gpu_reason(gpu: GpuMoment, way: str, x: int, y: int) -> str:
    """Return why the GPU's masks are invalid or occluded here, from the buffers that render/occlusion.py used."""
    if gpu["part"][y, x] < 0 and gpu["id"][y, x] == 0:
        return "nothing hit"
    w = float(gpu[f"next_depth_{way}"][y, x])
    flow = gpu[f"flow_{way}"][y, x]
    if not gpu[f"valid_{way}"][y, x]:
        return f"behind the camera at t' (Z' = {w:.6g})" if not w > 0 else "the flow is not finite"
    if not gpu[f"occluded_{way}"][y, x]:
        return ""
    renderer: Renderer = gpu.renderer
    xt, yt = x + float(flow[0]), y + float(flow[1])
    # A point that leaves the picture is occluded in any case.
    if not (-0.5 <= xt < renderer.width - 0.5 and -0.5 <= yt < renderer.height - 0.5):
        return f"outside the image at t' (x' = {xt:.3f}, y' = {yt:.3f})"
    if w < renderer.scene.camera.near:
        return f"in front of the near plane at t' (Z' = {w:.6g} < {renderer.scene.camera.near:g})"
    there = gpu.renderer.raw(getattr(gpu.when, f"{way}_ns"), "depth", "ids")
    # The pixel that contains the point then.
    xn, yn = int(np.floor(xt + 0.5)), int(np.floor(yt + 0.5))
    other = int(there["ids"][yn, xn])
    names = {body.instance_id: body.name for body in renderer.scene.objects}
    return (
        f"hidden at t': pixel ({xn}, {yn}) shows {names.get(other, other)} (id {other}) at depth "
        f"{there['depth'][yn, xn]:.6g}, the point is at Z' = {w:.6g}"
    )


# ------------------------------------------------------------------------------------------------- text


def as_text(result: dict) -> str:
    """Return the probe as fixed-width text."""
    x, y = result["pixel"]
    lines = [
        (
            f"pixel ({x}, {y}) at t = {result['t_s']:.9g} s; t' = {result['times_s']['forward']:.9g} s (forward), "
            f"{result['times_s']['backward']:.9g} s (backward)"
        )
    ]
    if result["band"]:
        lines.append(
            "in the silhouette band: the pixel's centre may fall on either side of an edge, so nothing is graded here"
        )
    lines += ["", f"{'':3}{'buffer':<20} {'GPU':<34} {'reference (float64)':<34} {'error':>10} {'ULPs':>9}  unit"]
    for row in result["buffers"]:
        mark = {True: "", False: "!!", None: ""}[row["ok"]]
        count = "" if row["ulps"] is None else f"{row['ulps']:.3g}"
        lines.append(
            f"{mark:3}{row['title']:<20} {_numbers(row['gpu']):<34} {_numbers(row['reference']):<34} "
            f"{row['error']:>10.3g} {count:>9}  {row['error_unit']}"
        )
        if row["note"]:
            lines.append(f"{'':24}{row['note']}")
    lines.append("")
    for side in ("gpu", "reference"):
        lines.append(f"{'GPU drew' if side == 'gpu' else 'reference hit':<14} {_surface_text(result['surface'][side])}")
    if result["positions"]:
        lines += ["", f"{'position':<20} {'GPU':<52} reference (float64)"]
        lines += [
            f"{row['name']:<20} {_numbers(row['gpu']):<52} {_numbers(row['reference'])}" for row in result["positions"]
        ]
    lines.append("")
    for way, why in result["why"].items():
        for side in ("gpu", "reference"):
            lines.append(f"{way:<9} {'GPU' if side == 'gpu' else 'reference':<10} {why[side] or 'seen at both times'}")
    return "\n".join(lines)


def _numbers(values) -> str:
    if values is None:
        return "-"
    if isinstance(values, bool):
        return "yes" if values else "no"
    if isinstance(values, int):
        return str(values)
    if isinstance(values, float):
        return f"{values:.8g}"
    return "  ".join(f"{v:.7g}" for v in values)


def _surface_text(s: dict) -> str:
    if s["object"] is None:
        return "nothing"
    bary = f", barycentrics {_numbers(s['bary'])}" if s["bary"] is not None else ""
    side = "" if "front" not in s else (", from the front" if s["front"] else ", from behind")
    texture = f", texture {s['texture']}" if s["texture"] else ""
    return (
        f"{s['object']} (id {s['instance']}, {s['category']}), part {s['part']} {s['mesh']}{texture}, triangle "
        f"{s['triangle']}{bary}{side}"
    )
