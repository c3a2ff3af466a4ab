"""The Blender side of ``played.py``: plays a glTF file as Blender's own importer understands it.

    python gltf_worker.py FOLDER        FOLDER/job.json in; FOLDER/played.npy out

job.json: file (absolute path), times (s), fps. played.npy: (T, V, 3) float64, vertices of all meshes in the order of
their names, in Blender's world (z up), at each time.

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
    meshes.sort(key=lambda thing: thing.name)
    found = []
    for t in job["times"]:
        say(doing=f"playing {t:g} s")
        frame = t * job["fps"]
        scene.frame_set(math.floor(frame + 1e-6), subframe=max(frame - math.floor(frame + 1e-6), 0.0))
        graph = bpy.context.evaluated_depsgraph_get()
        every = []
        for thing in meshes:
            shown = thing.evaluated_get(graph)
            mesh = shown.to_mesh()
            places = np.empty((len(mesh.vertices), 3), np.float32)
            mesh.vertices.foreach_get("co", places.ravel())
            shown.to_mesh_clear()
            T = np.array(shown.matrix_world, float)
            every.append(places.astype(float) @ T[:3, :3].T + T[:3, 3])
        found.append(np.concatenate(every))
    np.save(folder / "played.npy", np.stack(found))
    return 0


if __name__ == "__main__":
    status = main(Path(sys.argv[1]))
    sys.stderr.flush()
    os._exit(status)  # not through Blender's own end, which now and then waits for itself for ever
