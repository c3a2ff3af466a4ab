"""The Blender side of ``played.py``: plays a glTF file as Blender's own importer understands it.

    python gltf_worker.py FOLDER        FOLDER/job.json in; FOLDER/played.npz out

job.json: file (absolute path), times (s), fps, and, for silhouettes, camera {size, parameters (blinkgl.trade.
cycles.blender_camera), pose 4x4 in Blender's camera axes, near}, else null. played.npz: "mesh:NAME" (T, V, 3) float64,
vertices in Blender's world (z up) at each time; "masks" (T, H, W) bool, where the camera sees something.

A program of its own that needs nothing but numpy and ``bpy``, and imports nothing of BlinkGL. Standard output carries
one JSON object per line: ``{"blender"}``, ``{"doing"}``, ``{"error"}``.
"""

from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path

import numpy as np


def main(folder: Path) -> int:
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # Blender and its libraries print to standard output from C

    def say(**words):
        answers.write(json.dumps(words) + "\n")

    try:
        import bpy
    except ImportError as problem:
        say(error=f"bpy cannot be imported by Python {sys.version_info.major}.{sys.version_info.minor}: {problem}")
        return 1
    say(blender=bpy.app.version_string)
    job = json.loads((folder / "job.json").read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = job["fps"], 1.0
    say(doing="importing")
    bpy.ops.import_scene.gltf(filepath=job["file"], merge_vertices=False)
    # Shapes that stand for bones are hidden, and no part of the file.
    meshes = [o for o in scene.objects if o.type == "MESH" and not o.hide_get() and o.users_collection]
    meshes = [o for o in meshes if not any(c.name.startswith("glTF_not_exported") for c in o.users_collection)]
    for thing in scene.objects:
        thing.hide_render = thing.type == "MESH" and thing not in meshes
    if job["camera"] is not None:
        look(bpy, scene, job["camera"])
    found: dict[str, list[np.ndarray]] = {f"mesh:{o.name}": [] for o in meshes}
    masks = []
    for t in job["times"]:
        say(doing=f"playing {t:g} s")
        frame = t * job["fps"]
        scene.frame_set(math.floor(frame + 1e-6), subframe=max(frame - math.floor(frame + 1e-6), 0.0))
        graph = bpy.context.evaluated_depsgraph_get()
        for thing in meshes:
            shown = thing.evaluated_get(graph)
            mesh = shown.to_mesh()
            places = np.empty((len(mesh.vertices), 3), np.float32)
            mesh.vertices.foreach_get("co", places.ravel())
            shown.to_mesh_clear()
            T = np.array(shown.matrix_world, float)
            found[f"mesh:{thing.name}"].append(places.astype(float) @ T[:3, :3].T + T[:3, 3])
        if job["camera"] is not None:
            masks.append(silhouette(bpy, scene, folder / "mask.png"))
    arrays = {name: np.stack(places) for name, places in found.items()}
    np.savez(folder / "played.npz", masks=np.array(masks, bool), **arrays)
    return 0


def look(bpy, scene, camera: dict) -> None:
    """A camera, and Cycles with one path through the middle of each pixel."""
    lens = bpy.data.cameras.new("eye")
    for name, value in camera["parameters"].items():
        setattr(scene.render if name.startswith("pixel_aspect") else lens, name, value)
    lens.clip_start, lens.clip_end = camera["near"], 1e6
    eye = bpy.data.objects.new("eye", lens)
    scene.collection.objects.link(eye)
    eye.matrix_world = np.array(camera["pose"]).T  # columns first
    scene.camera = eye
    render = scene.render
    render.resolution_x, render.resolution_y = camera["size"]
    render.resolution_percentage = 100
    render.engine, render.film_transparent, render.dither_intensity = "CYCLES", True, 0.0
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGBA"
    scene.cycles.device, scene.cycles.samples = "CPU", 1
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BLACKMAN_HARRIS", 0.01  # the pixel's middle


def silhouette(bpy, scene, path: Path) -> np.ndarray:
    """(H, W) bool, row 0 at the top."""
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    width, height = image.size
    rgba = np.empty((height, width, 4), np.float32)
    image.pixels.foreach_get(rgba.ravel())
    bpy.data.images.remove(image)
    return rgba[::-1, :, 3] > 0.5


if __name__ == "__main__":
    status = main(Path(sys.argv[1]))
    sys.stderr.flush()
    os._exit(status)  # not through Blender's own end, which now and then waits for itself for ever
