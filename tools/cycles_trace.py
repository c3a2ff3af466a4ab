"""The Blender side of ``tools/cycles_light.py``: reads a scene from two plain files, path-traces its frames, writes
them as .npy.

    python cycles_trace.py FOLDER        FOLDER/job.json, FOLDER/job.npz in; FOLDER/000000.npy … out

A program of its own that needs nothing but numpy and ``bpy``, and imports nothing of BlinkGL: Blender is GPL, so it
stays in another process, and possibly in another interpreter, and only files pass between the two.
``cycles_light.export`` describes them.

Standard output carries one JSON object per line: ``{"blender"}`` when the scene stands, ``{"frame"}`` after each
frame, or ``{"error"}`` with a line for the user. What Blender itself prints goes to standard error.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

Blender = Any  # bpy has no types
FAR = 1e8  # far plane, world units: where Blender's picture ends, which BlinkGL's does not


def main(folder: Path) -> int:
    """Renders the job of a folder; the exit status."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # Blender and its libraries print to standard output from C

    def say(**words):
        answers.write(json.dumps(words) + "\n")

    try:
        import bpy  # pyrefly: ignore
    except ImportError as problem:
        say(error=f"bpy cannot be imported by Python {sys.version_info.major}.{sys.version_info.minor}: {problem}")
        return 1
    job = json.loads((folder / "job.json").read_text())
    with np.load(folder / "job.npz", allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    scene, bodies, lamps, camera = build(bpy, job, arrays)
    say(blender=f"Blender {bpy.app.version_string}")
    exr = folder / "frame.exr"
    for k in range(job["frames"]):
        for body, poses in zip(bodies, arrays["poses"]):
            place(body, poses[k])
        for lamp, poses in zip(lamps, arrays["lamp_poses"]):
            place(lamp, poses[k])
        place(camera, arrays["camera_poses"][k])
        if "exposed" in arrays:
            expose(scene, [*bodies, camera], arrays["exposed"][:, k])
        scene.render.filepath = str(exr)
        bpy.ops.render.render(write_still=True)
        part = folder / "part.npy"
        np.save(part, read_exr(bpy, exr, *job["size"]))
        part.rename(folder / f"{k:06d}.npy")
        say(frame=k)
    return 0


def expose(scene: Blender, movers: list, poses: np.ndarray) -> None:
    """The shutter is open, evenly, from the first to the last of (movers, M, 4, 4) poses, which are evenly spaced in
    time; in between Blender's own interpolation."""
    count = poses.shape[1]
    for body_part, its in zip(movers, poses):
        body_part.animation_data_clear()
        last = None
        for i, pose in enumerate(its):
            place(body_part, pose)
            # q and -q are one rotation; the linear way between two keys is the short one only for like signs.
            if last is not None and np.dot(last, body_part.rotation_quaternion) < 0:
                body_part.rotation_quaternion = [-q for q in body_part.rotation_quaternion]
            last = np.array(body_part.rotation_quaternion)
            for path in ("location", "rotation_quaternion"):
                body_part.keyframe_insert(path, frame=i)
        for curve in body_part.animation_data.action.fcurves:
            for key in curve.keyframe_points:
                key.interpolation = "LINEAR"
        for one in (body_part, *body_part.children):
            one.cycles.use_motion_blur, one.cycles.motion_steps = True, 4
    scene.frame_start, scene.frame_end = 0, count - 1
    scene.frame_set(0)
    render = scene.render
    render.use_motion_blur, render.motion_blur_position, render.motion_blur_shutter = True, "START", float(count - 1)
    for point in render.motion_blur_shutter_curve.curves[0].points:
        point.location[1] = 1.0
    render.motion_blur_shutter_curve.update()


def place(body_part: Blender, pose: np.ndarray) -> None:
    """Through a quaternion made here in float64: Blender takes float32."""
    body_part.location = pose[:3, 3]
    body_part.rotation_quaternion = quaternion(pose[:3, :3])


def quaternion(R: np.ndarray) -> np.ndarray:
    """(4,) w, x, y, z of a rotation matrix (Shepperd 1978: divides by the largest component)."""
    xx, yy, zz = np.diagonal(R)
    # squares[k] is 4 q_k^2, and products[i, k] is 4 q_i q_k: row k is q up to the factor 4 q_k.
    squares = np.array([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz])
    products = np.array(
        [
            [0, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [0, 0, R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [0, 0, 0, R[1, 2] + R[2, 1]],
            [0, 0, 0, 0],
        ]
    )
    k = int(squares.argmax())
    q = (products + products.T)[k]
    q[k] = squares[k]
    return q / np.linalg.norm(q)


def read_exr(bpy: Blender, path: Path, width: int, height: int) -> np.ndarray:
    """(H, W, 3) float32 linear radiance, row 0 at the top."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    rgba = np.empty((height, width, 4), np.float32)
    image.pixels.foreach_get(rgba.ravel())
    bpy.data.images.remove(image)
    return np.ascontiguousarray(rgba[::-1, :, :3])


# ------------------------------------------------------------------------------------------------------------- scene


def build(bpy: Blender, job: dict, arrays: dict) -> Blender:
    """(scene, objects in the order of the job's bodies, lamps in its order, camera)."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    images = {}
    # Without shadows nothing is in the way of the dome: its share is a formula, and needs no paths.
    open_ = not (job["settings"]["shadows"] and job["settings"]["occlusion"])
    light = job["light"]
    formula = open_ and "panorama" not in arrays and all(paint["gloss"] is None for paint in job["materials"])
    even_sky = [light["sky"] * c if formula else 0.0 for c in light["sky_color"]]
    materials = [make_material(bpy, m, k, images, arrays, even_sky) for k, m in enumerate(job["materials"])]
    meshes: dict[tuple[int, int], Blender] = {}
    bodies = []
    for body in job["bodies"]:
        root = bpy.data.objects.new(body["name"], None)
        root.rotation_mode = "QUATERNION"
        scene.collection.objects.link(root)
        bodies.append(root)
        for mesh, material in body["parts"]:
            if (mesh, material) not in meshes:
                meshes[mesh, material] = make_mesh(bpy, mesh, arrays)
                meshes[mesh, material].materials.append(materials[material])
            body_part = bpy.data.objects.new(body["name"], meshes[mesh, material])
            body_part.parent = root
            solid = not body["picture_only"]
            body_part.visible_shadow = solid and job["settings"]["shadows"]
            body_part.visible_diffuse = solid and not open_  # what a ray to the dome meets
            body_part.visible_glossy = body_part.visible_transmission = False
            scene.collection.objects.link(body_part)
    make_light(bpy, scene, job, arrays.get("panorama"), 0.0 if formula else light["sky"])
    camera = make_camera(bpy, scene, job)
    adjust(scene, job["settings"])
    scene.render.resolution_x, scene.render.resolution_y = job["size"]
    scene.render.resolution_percentage = 100
    lamps = [make_lamp(bpy, scene, lamp, job["settings"]["shadows"]) for lamp in job["light"]["lamps"]]
    return scene, bodies, lamps, camera


def make_mesh(bpy: Blender, k: int, arrays: dict) -> Blender:
    """Mesh ``k`` with its normals, texture coordinates and colours."""
    mesh = bpy.data.meshes.new(f"mesh {k}")
    faces = arrays[f"faces{k}"]
    mesh.from_pydata(arrays[f"vertices{k}"], [], faces, shade_flat=False)
    mesh.uv_layers.new().uv.foreach_set("vector", arrays[f"uvs{k}"][faces.ravel()].ravel())
    # A plain vector attribute of this name is taken as it is; normals_split_custom_set would round to 16 bits.
    mesh.attributes.new("custom_normal", "FLOAT_VECTOR", "POINT").data.foreach_set(
        "vector", arrays[f"normals{k}"].ravel()
    )
    if f"colours{k}" in arrays:
        rgba = np.ones((len(arrays[f"colours{k}"]), 4), np.float32)
        rgba[:, :3] = arrays[f"colours{k}"]
        mesh.color_attributes.new("tint", "FLOAT_COLOR", "POINT").data.foreach_set("color", rgba.ravel())
    mesh.update()
    return mesh


def make_material(bpy: Blender, paint: dict, k: int, images: dict, arrays: dict, even_sky: list[float]) -> Blender:
    """Unlit: emission that only the camera sees. Lit: a diffuse BSDF, and albedo * even_sky * (0.5 + 0.5 n_z) as
    emission, or a principled one. Culled: nothing where the camera sees a back face."""
    material = bpy.data.materials.new(f"material {k}")
    material.use_nodes = True
    material.use_transparent_shadow = paint["alpha"] is not None  # what is culled is culled for the camera alone
    material.cycles.emission_sampling = "NONE"
    tree = material.node_tree
    tree.nodes.clear()
    add, link = tree.nodes.new, tree.links.new
    if paint["unlit"]:
        surface = add("ShaderNodeEmission")
        link(add("ShaderNodeLightPath").outputs["Is Camera Ray"], surface.inputs["Strength"])
    elif paint["gloss"] is not None:
        surface = add("ShaderNodeBsdfPrincipled")
        surface.distribution = "MULTI_GGX"
        for name, value in zip(("Metallic", "Roughness"), paint["gloss"]):
            surface.inputs[name].default_value = value
    else:
        surface = add("ShaderNodeBsdfDiffuse")
        surface.inputs["Roughness"].default_value = 0.0
    normal = None
    if paint["bumps"] is not None:
        normal = add("ShaderNodeNormalMap")
        picture = picture_of(bpy, tree, paint["bumps"], images, arrays)
        if paint["bump_scale"] != 1:
            raise ValueError("normal maps are taken as they are")
        link(picture.outputs["Color"], normal.inputs["Color"])
        link(normal.outputs[0], surface.inputs["Normal"])
    glow = None
    if max(even_sky) > 0 and not paint["unlit"] and paint["gloss"] is None:
        glow = add("ShaderNodeEmission")
        axes, up = add("ShaderNodeSeparateXYZ"), add("ShaderNodeMath")
        up.operation = "MULTIPLY_ADD"
        up.inputs[1].default_value = up.inputs[2].default_value = 0.5
        link((normal or add("ShaderNodeNewGeometry")).outputs["Normal"], axes.inputs[0])
        link(axes.outputs["Z"], up.inputs[0])
        link(up.outputs[0], glow.inputs["Strength"])
    factors = []
    if paint["texture"] is not None:
        factors.append(picture_of(bpy, tree, paint["texture"], images, arrays).outputs["Color"])
    if paint["tinted"]:
        tint = add("ShaderNodeAttribute")
        tint.attribute_name = "tint"
        factors.append(tint.outputs["Color"])
    principled = paint["gloss"] is not None and not paint["unlit"]
    for node, more in ((surface, (1.0, 1.0, 1.0)), (glow, even_sky)):
        if node is None:
            continue
        base = [a * b for a, b in zip(paint["base_color"], more)]
        colour = node.inputs["Base Color" if principled and node is surface else "Color"]
        colour.default_value = [*base, 1.0]
        out = None
        for factor in factors:
            product = add("ShaderNodeVectorMath")
            product.operation = "MULTIPLY"
            link(factor, product.inputs[0])
            if out is None:
                product.inputs[1].default_value = base
            else:
                link(out, product.inputs[1])
            out = product.outputs["Vector"]
        if out is not None:
            link(out, colour)
    shader = surface.outputs[0]
    own = None
    if any(paint["emission"]) and not paint["unlit"]:
        own = add("ShaderNodeEmission")
        own.inputs["Color"].default_value = [*paint["emission"], 1.0]
        link(add("ShaderNodeLightPath").outputs["Is Camera Ray"], own.inputs["Strength"])
    for more in (glow, own):
        if more is not None:
            both = add("ShaderNodeAddShader")
            link(shader, both.inputs[0])
            link(more.outputs[0], both.inputs[1])
            shader = both.outputs[0]
    if paint["alpha"] is not None:
        there, mix = add("ShaderNodeMath"), add("ShaderNodeMixShader")
        there.operation = "GREATER_THAN"
        there.inputs[1].default_value = paint["threshold"]
        link(picture_of(bpy, tree, paint["alpha"], images, arrays).outputs["Color"], there.inputs[0])
        link(there.outputs[0], mix.inputs[0])
        link(add("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[1])
        link(shader, mix.inputs[2])
        shader = mix.outputs[0]
    if paint["culled"]:
        seen = add("ShaderNodeMath")
        seen.operation = "MULTIPLY"
        link(add("ShaderNodeNewGeometry").outputs["Backfacing"], seen.inputs[0])
        link(add("ShaderNodeLightPath").outputs["Is Camera Ray"], seen.inputs[1])
        mix = add("ShaderNodeMixShader")
        link(seen.outputs[0], mix.inputs[0])
        link(shader, mix.inputs[1])
        link(add("ShaderNodeBsdfTransparent").outputs[0], mix.inputs[2])
        shader = mix.outputs[0]
    link(shader, add("ShaderNodeOutputMaterial").inputs["Surface"])
    return material


def picture_of(bpy: Blender, tree: Blender, k: int, images: dict, arrays: dict) -> Blender:
    """A node that looks texture k up, bilinear, repeated."""
    picture = tree.nodes.new("ShaderNodeTexImage")
    picture.image = images.get(k) or images.setdefault(k, make_image(bpy, f"texture{k}", arrays))
    picture.interpolation, picture.extension = "Linear", "REPEAT"
    return picture


def make_image(bpy: Blender, name: str, arrays: dict) -> Blender:
    """Linear float texels, used as they are; Blender's row 0 is the bottom one."""
    texels = arrays[name][::-1]
    height, width, _ = texels.shape
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=True, is_data=True)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = texels
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    return image


def make_light(bpy: Blender, scene: Blender, job: dict, panorama: np.ndarray | None, sky: float) -> None:
    """Sun without extent, and a dome that is of one colour above the horizon and black below: without anything in
    between it gives an upward-facing share of 0.5 + 0.5 n_z, exactly BlinkGL's sky; or a panorama. The camera sees
    the background instead of the dome.

    sky : strength of the dome, 0 where it is in the materials (see make_material)."""
    light = job["light"]
    if light["sun"] > 0:
        lamp = bpy.data.lights.new("sun", "SUN")
        lamp.energy, lamp.angle = np.pi * light["sun"], 0.0  # W/m²; a Lambert surface sends 1/pi of it to every side
        lamp.use_shadow = job["settings"]["shadows"]
        sun = bpy.data.objects.new("sun", lamp)
        sun.rotation_mode = "QUATERNION"
        sun.rotation_quaternion = quaternion(turn_z_to(np.asarray(light["sun_direction"], float)))
        scene.collection.objects.link(sun)
    world = scene.world = bpy.data.worlds.new("world")
    world.use_nodes = True
    # The surface's own cosine distribution finds a dome best; a panorama is looked for where it is bright, by rays that
    # what casts shadows would stop; what mirrors finds it in its mirror.
    smooth = any(paint["gloss"] is not None and paint["gloss"][1] < 0.3 for paint in job["materials"])
    by_brightness = panorama is not None and not job["settings"]["shadows"] and not smooth
    world.cycles.sampling_method = "AUTOMATIC" if by_brightness else "NONE"
    tree = world.node_tree
    tree.nodes.clear()
    add, link = tree.nodes.new, tree.links.new
    split = add("ShaderNodeSeparateXYZ")
    link(add("ShaderNodeTexCoord").outputs["Generated"], split.inputs[0])
    above = add("ShaderNodeMath")
    above.operation = "GREATER_THAN"
    above.inputs[1].default_value = 0.0
    link(split.outputs["Z"], above.inputs[0])
    scale = add("ShaderNodeMath")
    scale.operation = "MULTIPLY"
    scale.inputs[1].default_value = sky
    link(above.outputs[0], scale.inputs[0])
    seen, dome, backdrop = (add(f"ShaderNode{kind}") for kind in ("MixShader", "Background", "Background"))
    dome.inputs["Color"].default_value = [*light["sky_color"], 1.0]
    link(scale.outputs[0], dome.inputs["Strength"])
    if panorama is not None:
        around = add("ShaderNodeTexEnvironment")
        around.image, around.interpolation = make_image(bpy, "panorama", {"panorama": panorama}), "Linear"
        link(around.outputs["Color"], dome.inputs["Color"])
        dome.inputs["Strength"].default_value = 1.0
        tree.links.remove(dome.inputs["Strength"].links[0])
    backdrop.inputs["Strength"].default_value = job["background"]
    backdrop.inputs["Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    link(add("ShaderNodeLightPath").outputs["Is Camera Ray"], seen.inputs[0])
    link(dome.outputs[0], seen.inputs[1])
    link(backdrop.outputs[0], seen.inputs[2])
    out = add("ShaderNodeOutputWorld")
    link(seen.outputs[0], out.inputs["Surface"])
    if job["fog"] is not None:
        link(fog_nodes(tree, *job["fog"]).outputs[0], out.inputs["Volume"])


def fog_nodes(tree: Blender, density: float, radiance: float) -> Blender:
    """What swallows and sends light between the camera and what it sees, and is not there for rays to lamps: from the
    camera L becomes L e^(-density d) + radiance (1 - e^(-density d))."""
    add, link = tree.nodes.new, tree.links.new
    both, swallows, sends = (add(f"ShaderNode{kind}") for kind in ("AddShader", "VolumeAbsorption", "Emission"))
    swallows.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    path = add("ShaderNodeLightPath")
    for node, name, strength in ((swallows, "Density", density), (sends, "Strength", density * radiance)):
        seen = add("ShaderNodeMath")
        seen.operation = "MULTIPLY"
        seen.inputs[1].default_value = strength
        link(path.outputs["Is Camera Ray"], seen.inputs[0])
        link(seen.outputs[0], node.inputs[name])
    link(swallows.outputs[0], both.inputs[0])
    link(sends.outputs[0], both.inputs[1])
    return both


def make_lamp(bpy: Blender, scene: Blender, lamp: dict, shadows: bool) -> Blender:
    """A strength is the radiance of a white surface that faces it, of a point or spot light 1 unit away: an irradiance
    of pi times that, and a power of 4 pi² times that, which Blender sends to all sides, whatever the cone."""
    light = bpy.data.lights.new(lamp["kind"], lamp["kind"].upper())
    # Blender has a colour and an energy: the colour holds the ratios, the energy the largest strength.
    largest = max(*lamp["strength"], 1e-30)
    light.color = [s / largest for s in lamp["strength"]]
    light.energy = (np.pi if lamp["kind"] == "sun" else 4 * np.pi**2) * largest
    light.use_shadow = shadows
    if lamp["kind"] == "sun":
        light.angle = lamp["size"]
    else:
        light.shadow_soft_size = lamp["size"] / 2
    if lamp["kind"] == "spot":
        light.spot_size, light.spot_blend = 2 * lamp["outer"], lamp["blend"]
    body_part = bpy.data.objects.new(lamp["kind"], light)
    body_part.rotation_mode = "QUATERNION"
    scene.collection.objects.link(body_part)
    return body_part


def turn_z_to(axis: np.ndarray) -> np.ndarray:
    """(3, 3) a rotation whose z axis is ``axis`` (a sun lamp shines along its -z)."""
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def make_camera(bpy: Blender, scene: Blender, job: dict) -> Blender:
    """The scene's camera, with its lens."""
    lens = bpy.data.cameras.new("camera")
    for name, value in job["blender_camera"].items():
        setattr(scene.render if name.startswith("pixel_aspect") else lens, name, value)
    lens.clip_start, lens.clip_end = job["near"], FAR
    if job["lens"] is not None:
        diameter, focus = job["lens"]
        lens.dof.use_dof, lens.dof.focus_distance = True, focus
        lens.dof.aperture_fstop = 1e-3 * lens.lens / diameter  # Blender's focal length is in mm, its units are metres
        lens.dof.aperture_blades, lens.dof.aperture_ratio = 0, 1.0
    camera = bpy.data.objects.new("camera", lens)
    camera.rotation_mode = "QUATERNION"
    scene.collection.objects.link(camera)
    scene.camera = camera
    return camera


def adjust(scene: Blender, settings: dict) -> None:
    """Plain radiance in 32-bit floats: no view transform, no denoiser, no clamping, no
    adaptive sampling; a box of one pixel."""
    render = scene.render
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    render.image_settings.color_mode, render.image_settings.exr_codec = "RGBA", "NONE"
    scene.view_settings.view_transform = "Raw"
    render.use_persistent_data = True
    render.film_transparent = False
    render.use_motion_blur = False
    render.dither_intensity = 0.0
    if settings["threads"]:
        render.threads_mode, render.threads = "FIXED", settings["threads"]
    render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.samples, cycles.seed, cycles.use_animated_seed = settings["samples"], settings["seed"], False
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.pixel_filter_type = "BOX"
    cycles.max_bounces = cycles.diffuse_bounces = settings["bounces"]
    cycles.glossy_bounces = cycles.transmission_bounces = cycles.volume_bounces = 0
    # Rays pass holes and culled faces, each of which takes one of these, and none of the bounces above.
    cycles.transparent_max_bounces = 64
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.light_sampling_threshold = 0.0
    cycles.caustics_reflective = cycles.caustics_refractive = False


if __name__ == "__main__":
    status = main(Path(sys.argv[1]))
    sys.stderr.flush()
    os._exit(status)  # not through Blender's own end, which now and then waits for itself for ever
