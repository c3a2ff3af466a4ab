"""Small glTF files, one a feature, named after Khronos' sample models and glTF-Asset-Generator. Each of ``MODELS`` adds
to a builder what its name says."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from PIL import Image

from blinkgl.config.deform import AnimationConfig
from tests.scene.gltf_files import GltfBuilder

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
ONCE = AnimationConfig(loop=False)


@dataclass(frozen=True)
class Model:
    """A file, the clip's play or None, and the seconds between which it is seen.

    true : times of the clip at these two, where they differ.
    """

    build: Callable[[Models], object]
    play: AnimationConfig | None = None
    at: float = 0.3
    to: float = 0.36
    true: tuple[float, float] | None = None


def cube(size=1.6):
    points, faces, uvs = [], [], []
    for axis in range(3):
        for sign in (1, -1):
            first = len(points)
            for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                p = np.zeros(3)
                p[axis], p[(axis + 1) % 3], p[(axis + 2) % 3] = sign, u * sign, v
                points.append(p * size / 2)
                uvs.append(((u + 1) / 2, (v + 1) / 2))
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    points = np.array(points)
    normals = np.repeat([np.cross(points[i + 1] - points[i], points[i + 3] - points[i]) for i in range(0, 24, 4)], 4, 0)
    return points, np.array(faces), normals / np.linalg.norm(normals, axis=1, keepdims=True), np.array(uvs)


class Models(GltfBuilder):
    """A builder with what many features need."""

    def add(self, values, kind, dtype="f4", **more):
        return self.array(np.asarray(values, dtype), kind, **more)

    def colour(self, *rgba, **more):
        material = {"pbrMetallicRoughness": {"baseColorFactor": list(rgba) or [0.8, 0.3, 0.1, 1], "metallicFactor": 0}}
        self.tree.setdefault("materials", []).append({**material, **more})
        return len(self.tree["materials"]) - 1

    def picture(self, form="PNG", alpha=None, sampler=None, info=None, texture=None, **more):
        """A material of 4 x 4 colours, 16 pixels each."""
        rng = np.random.default_rng(4)
        texels = rng.integers(0, 256, (4, 4, 4), dtype=np.uint8)
        texels[..., 3] = 255 if alpha is None else np.array(alpha, np.uint8)
        out = io.BytesIO()
        Image.fromarray(texels.repeat(16, 0).repeat(16, 1)).save(
            out, form, **({"lossless": True} if form == "WEBP" else {})
        )
        self.tree.setdefault("images", []).append(
            {"bufferView": self.view(out.getvalue()), "mimeType": f"image/{form.lower()}"}
        )
        self.tree["textures"] = [texture or {"source": 0}]
        if sampler:
            self.tree["samplers"], self.tree["textures"][0]["sampler"] = [sampler], 0
        number = self.colour(1, 1, 1, 1, **more)
        self.tree["materials"][number]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0, **(info or {})}
        return number

    def box(self, material=None, size=1.6, faces=slice(None), inward=False, **attributes):
        points, triangles, normals, uvs = cube(size)
        if inward:
            triangles, normals = triangles[:, ::-1], -normals
        number = self.mesh(points, triangles[faces], normals, uvs, self.colour() if material is None else material)
        self.tree["meshes"][number]["primitives"][0]["attributes"].update(attributes)
        return number

    def square(self, material=None):
        material = self.colour() if material is None else material
        return self.mesh(SQUARE, ((0, 1, 2), (0, 2, 3)), uvs=(SQUARE[:, :2] + 1) / 2, material=material)

    def bare(self, points, order=None, **more):
        """A mesh of nothing but positions."""
        attributes = {"POSITION": self.add(points, "VEC3")}
        if order is not None:
            more["indices"] = self.add(np.array(order)[:, None], "SCALAR", "u2")
        return self.primitive(attributes, material=self.colour(), **more)

    def use(self, *names, root=None):
        self.tree["extensionsUsed"] = list(names)
        self.tree["extensionsRequired"] = list(names)
        self.tree.update({"extensions": root} if root else {})


def about(axis, *angles):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return [[*(axis * np.sin(np.radians(a) / 2)), np.cos(np.radians(a) / 2)] for a in angles]


TILTED = about((1, 0, 0), -50)[0]
PLACED = {"offset": [0.25, 0.5], "rotation": 0.4, "scale": [0.7, 1.5]}
HOLES = [[255, 255, 0, 255], [0, 255, 255, 255], [255, 0, 255, 0], [255, 255, 255, 0]]


def shades(seed, codes, channels):
    return np.random.default_rng(seed).integers(0, codes, (24, channels))


def box_without_normals_is_flat(b):
    points = np.array(
        [[np.cos(a), h, np.sin(a)] for a in np.linspace(0, 2 * np.pi, 16, endpoint=False) for h in (-1, 1)]
    )
    faces = [[2 * k, 2 * k + 1, (2 * k + 3) % 32] for k in range(16)] + [
        [2 * k, (2 * k + 3) % 32, (2 * k + 2) % 32] for k in range(16)
    ]
    b.node(mesh=b.mesh(points, faces, material=b.colour()))


def points_and_lines_beside_a_box(b):
    number = b.box()
    b.tree["meshes"][number]["primitives"] += [{"attributes": {"POSITION": 0}, "mode": mode} for mode in (0, 1, 2, 3)]
    b.node(mesh=number)


def interleaved(b):
    points, faces, normals, _ = cube()
    b.strided(
        np.hstack([points, normals]).astype("f4"), {"componentType": 5126}, {"componentType": 5126, "byteOffset": 12}
    )
    indices = b.add(faces.reshape(-1, 1), "SCALAR", "u1")
    b.node(mesh=b.primitive({"POSITION": 0, "NORMAL": 1}, indices=indices, material=b.colour()))


def sparse_accessor(b):
    number = b.box()
    at, new = b.view(np.array([3, 8], "u2").tobytes()), b.view(np.array([[0.2, 1.4, 0.3], [1, 1, 1.0]], "f4").tobytes())
    b.tree["accessors"][0]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": at, "componentType": 5123},
        "values": {"bufferView": new},
    }
    b.node(mesh=number)


def sparse_without_a_buffer(b):
    at, new = b.view(np.array([1, 2], "u1").tobytes()), b.view(np.array([[1.5, 0, 0], [0, 1.5, 0]], "f4").tobytes())
    sparse = {"count": 2, "indices": {"bufferView": at, "componentType": 5121}, "values": {"bufferView": new}}
    b.tree["accessors"].append({"componentType": 5126, "count": 3, "type": "VEC3", "sparse": sparse})
    b.node(mesh=b.primitive({"POSITION": 0}, material=b.colour(doubleSided=True)))


def quantised_mesh(b):
    b.use("KHR_mesh_quantization")
    points, faces, normals, _ = cube(2)
    # A row of three is padded to four: the standard wants rows of whole words.
    b.strided(np.pad(points * 100, ((0, 0), (0, 1))).astype("i2"), {"componentType": 5122})
    b.strided(np.pad(normals * 127, ((0, 0), (0, 1))).astype("i1"), {"componentType": 5120, "normalized": True})
    indices = b.add(faces.reshape(-1, 1), "SCALAR", "u2")
    b.node(mesh=b.primitive({"POSITION": 0, "NORMAL": 1}, indices=indices, material=b.colour()), scale=[0.008] * 3)


def two_primitives(b):
    one, other = b.box(), b.square(b.colour(0.1, 0.2, 0.9, 1, doubleSided=True))
    b.tree["meshes"][one]["primitives"] += b.tree["meshes"].pop(other)["primitives"]
    b.node(mesh=one, rotation=about((0, 1, 0), 25)[0])


def one_mesh_at_many_nodes(b):
    mesh = b.box(size=0.5)
    for k in range(5):
        b.node(mesh=mesh, translation=[k * 0.6 - 1.2, 0.2 * k, 0], rotation=about((1, k, 0), 30 * k)[0])


def second_scene(b):
    b.node(mesh=b.box(size=3))
    shown = b.node(root=False, mesh=b.box())
    b.tree["scenes"].append({"nodes": [shown]})
    b.tree["scene"] = 1


def second_texture_coordinates(b):
    number = b.box(b.picture(info={"texCoord": 1}), TEXCOORD_1=b.add(cube()[3][:, ::-1], "VEC2"))
    b.tree["meshes"][number]["primitives"][0]["_set"] = 1
    b.node(mesh=number)


def material_variants(b):
    b.use("KHR_materials_variants", root={"KHR_materials_variants": {"variants": [{"name": "blue"}]}})
    number = b.box()
    mapping = {"KHR_materials_variants": {"mappings": [{"material": b.colour(0, 0, 1, 1), "variants": [0]}]}}
    b.tree["meshes"][number]["primitives"][0]["extensions"] = mapping
    b.node(mesh=number)


def no_material(b):
    number = b.box()
    del b.tree["meshes"][number]["primitives"][0]["material"]
    b.node(mesh=number)


def bump(b, number, **more):
    points, _, normals, _ = cube()
    moved = points * [0.5, 0, 0] + [0.2, 0.4, 0]
    target = {"POSITION": b.add(moved, "VEC3"), "NORMAL": b.add(normals * 0, "VEC3")}
    b.tree["meshes"][number]["primitives"][0]["targets"] = [target, {"POSITION": b.add(points * [0, 0, 0.6], "VEC3")}]
    b.tree["meshes"][number].update(more)
    return number


def skinned(b, joints=2, sets=1, node=None, scales=None, **more):
    """A box whose lower half follows the first joint and whose upper half the last."""
    points = cube()[0]
    ids, weights = np.zeros((24, 4 * sets), int), np.zeros((24, 4 * sets))
    high = points[:, 1] > 0
    ids[high, -1], weights[high, -1], weights[~high, 0] = joints - 1, 1, 1
    attributes = {}
    for k in range(sets):
        attributes[f"JOINTS_{k}"] = b.add(ids[:, 4 * k : 4 * k + 4], "VEC4", "u1")
        attributes[f"WEIGHTS_{k}"] = b.add(weights[:, 4 * k : 4 * k + 4], "VEC4")
    number, bind = b.box(**attributes), np.tile(np.eye(4), (joints, 1, 1))
    bind[1:, 1, 3] = -0.3
    names = [
        b.node(root=False, translation=[0, 0.3 * (k > 0), 0], scale=(scales or {}).get(k, [1, 1, 1]))
        for k in range(joints)
    ]
    b.tree["nodes"][names[0]]["children"] = names[1:]
    b.tree["scenes"][0]["nodes"].append(names[0])
    b.tree["skins"] = [{"joints": names, "inverseBindMatrices": b.add(bind.swapaxes(1, 2).reshape(-1, 16), "MAT4")}]
    b.node(mesh=number, skin=0, **(node or {}), **more)
    return names


STILL: dict[str, Callable[[Models], object]] = {
    # geometry
    "triangle_without_indices": lambda b: b.node(mesh=b.bare(SQUARE[:3]), rotation=about((1, 0, 0), -70)[0]),
    "triangle_strip": lambda b: b.node(mesh=b.bare(SQUARE, [0, 1, 3, 2], mode=5), rotation=TILTED),
    "triangle_strip_without_indices": lambda b: b.node(mesh=b.bare(SQUARE[[0, 1, 3, 2]], mode=5), rotation=TILTED),
    "triangle_fan": lambda b: b.node(mesh=b.bare(SQUARE, [2, 3, 0, 1], mode=6), rotation=TILTED),
    "triangle_fan_mirrored": lambda b: b.node(
        mesh=b.bare(SQUARE, [2, 3, 0, 1], mode=6), scale=[1, 1, -1], rotation=about((1, 0, 0), 130)[0]
    ),
    "box": lambda b: b.node(mesh=b.box()),
    "box_without_normals_is_flat": box_without_normals_is_flat,
    "points_and_lines_beside_a_box": points_and_lines_beside_a_box,
    "interleaved": interleaved,
    "sparse_accessor": sparse_accessor,
    "sparse_without_a_buffer": sparse_without_a_buffer,
    "quantised_mesh": quantised_mesh,
    "two_primitives": two_primitives,
    # sides
    "single_sided_from_behind": lambda b: (
        b.node(mesh=b.square(), rotation=about((0, 1, 0), 180)[0], translation=[0, 0, 0]),
        b.node(mesh=b.box(size=0.7), translation=[1, 0, 0]),
    ),
    "double_sided_from_behind": lambda b: b.node(
        mesh=b.square(b.colour(doubleSided=True)), rotation=about((0, 1, 0), 180)[0]
    ),
    "room_around_the_camera": lambda b: b.node(mesh=b.box(b.picture(), 12, inward=True)),
    # Single-sided and facing outwards: nothing of it is seen from inside.
    "box_around_the_camera": lambda b: (b.node(mesh=b.box(size=12)), b.node(mesh=b.box(size=1))),
    "dome": lambda b: b.node(mesh=b.box(size=1.5, faces=slice(2, None), inward=True)),
    "open_box_double_sided": lambda b: b.node(
        mesh=b.box(b.colour(doubleSided=True), 1.5, slice(10)), rotation=about((1, 1, 0), 200)[0]
    ),
    # nodes
    "negative_scale": lambda b: b.node(mesh=b.box(b.picture()), scale=[-1, 1, 1.3], translation=[0.2, 0, 0]),
    "negative_scale_twice": lambda b: b.node(mesh=b.box(b.picture()), scale=[-1, -1, 1.2]),
    "negative_scale_of_a_parent": lambda b: (
        b.node(children=[b.node(root=False, mesh=b.square(), rotation=about((1, 0, 0), -60)[0])], scale=[1, 1, -1]),
        b.node(mesh=b.box(size=0.6), translation=[1.2, 0, 0]),
    ),
    "node_matrix": lambda b: b.node(
        mesh=b.box(), matrix=[0.7, 0, 0.7, 0, 0, 1.2, 0, 0, -0.7, 0.3, 0.7, 0, 0.1, 0.2, 0, 1]
    ),
    "node_matrix_mirrored": lambda b: b.node(
        mesh=b.box(b.picture()), matrix=[0.7, 0, 0.7, 0, 0, -1.2, 0, 0, -0.7, 0.3, 0.7, 0, 0.1, 0.2, 0, 1]
    ),
    "scale_of_zero": lambda b: (b.node(mesh=b.box()), b.node(mesh=b.box(size=3), scale=[0, 0, 0])),
    "scale_of_zero_of_a_parent": lambda b: (
        b.node(mesh=b.box()),
        b.node(scale=[0, 0, 0], children=[b.node(root=False, mesh=b.box(size=3))]),
    ),
    "flat_scale": lambda b: b.node(
        mesh=b.square(b.colour(doubleSided=True)), scale=[1, 1, 0], rotation=about((0, 1, 0), 30)[0]
    ),
    "small_scale": lambda b: b.node(scale=[1e-4] * 3, children=[b.node(root=False, mesh=b.box(size=1.6e4))]),
    "unequal_scales": lambda b: b.node(mesh=b.box(), scale=[0.4, 1.5, 1], rotation=about((1, 2, 0), 40)[0]),
    "shear": lambda b: b.node(
        children=[b.node(root=False, mesh=b.box(), rotation=about((0, 0, 1), 40)[0])], scale=[0.5, 1.4, 1]
    ),
    "hidden_node": lambda b: (
        b.use("KHR_node_visibility"),
        b.node(mesh=b.box()),
        b.node(
            children=[b.node(root=False, mesh=b.box(size=3))], extensions={"KHR_node_visibility": {"visible": False}}
        ),
    ),
    "one_mesh_at_many_nodes": one_mesh_at_many_nodes,
    "second_scene": second_scene,
    # materials
    "vertex_colours": lambda b: b.node(
        mesh=b.box(b.colour(1, 1, 1, 1), COLOR_0=b.add(np.random.default_rng(1).random((24, 3)), "VEC3"))
    ),
    "vertex_colours_of_bytes": lambda b: b.node(
        mesh=b.box(b.colour(0.5, 1, 1, 1), COLOR_0=b.add(shades(2, 256, 4), "VEC4", "u1", normalized=True))
    ),
    "vertex_colours_of_shorts": lambda b: b.node(
        mesh=b.box(
            b.colour(1, 1, 1, 1),
            COLOR_0=b.add(np.pad(shades(3, 65536, 3), ((0, 0), (0, 1))), "VEC4", "u2", normalized=True),
        )
    ),
    "textured": lambda b: b.node(mesh=b.box(b.picture())),
    "textured_by_webp": lambda b: (
        b.use("EXT_texture_webp"),
        b.node(mesh=b.box(b.picture("WEBP", texture={"extensions": {"EXT_texture_webp": {"source": 0}}}))),
    ),
    "texture_coordinates_of_shorts": lambda b: b.node(
        mesh=b.box(b.picture(), TEXCOORD_0=b.add(cube()[3] * 65535, "VEC2", "u2", normalized=True))
    ),
    "texture_transform": lambda b: (
        b.use("KHR_texture_transform"),
        b.node(mesh=b.box(b.picture(info={"extensions": {"KHR_texture_transform": PLACED}}))),
    ),
    "second_texture_coordinates": second_texture_coordinates,
    "texture_clamped": lambda b: b.node(
        mesh=b.box(b.picture(sampler={"wrapS": 33071, "wrapT": 33071}), TEXCOORD_0=b.add(cube()[3] * 2 - 0.5, "VEC2"))
    ),
    "texture_mirrored": lambda b: b.node(
        mesh=b.box(
            b.picture(sampler={"wrapS": 33648, "wrapT": 10497}), TEXCOORD_0=b.add(cube()[3] * 2.5 - 0.75, "VEC2")
        )
    ),
    "material_variants": material_variants,
    "masked": lambda b: b.node(mesh=b.box(b.picture(alpha=HOLES, alphaMode="MASK"))),
    "masked_everywhere": lambda b: (
        b.node(mesh=b.box(b.colour(1, 0, 0, 0.3, alphaMode="MASK"), size=3)),
        b.node(mesh=b.box(size=1)),
    ),
    "no_material": no_material,
    # shapes that could change
    "morphed_at_rest": lambda b: b.node(mesh=bump(b, b.box(), weights=[0.7, 0.2])),
    "morphed_by_its_node": lambda b: b.node(mesh=bump(b, b.box(), weights=[0.7, 0.2]), weights=[0.1, 1]),
    "skin_at_rest": lambda b: skinned(b, scales={1: [1.3, 1, 1]}),
    "skin_whose_node_is_elsewhere": lambda b: skinned(b, node={"translation": [9, 9, 9], "scale": [3, 3, 3]}),
    "skin_mirrored_at_rest": lambda b: skinned(b, scales={0: [-1, 1, 1]}),
}


def first_key_later(b):
    b.clip(b.node(mesh=b.box()), "translation", [0.5, 1], [[0.5, 0, 0], [0, 0.5, 0]])


def scale_through_zero(b):
    b.clip(b.node(mesh=b.box(b.picture())), "scale", [0, 1], [[1, 1, 1], [-1, 1, 1]])
    b.node(mesh=b.square(), translation=[0, 0, -1.5])


def scale_jumps_to_negative(b):
    square = b.node(mesh=b.square(), rotation=about((1, 0, 0), -60)[0])
    b.clip(square, "scale", [0, 0.5], [[1, 1, 1], [1, 1, -1]], "STEP")
    b.clip(b.node(mesh=b.box(b.picture(), size=0.8)), "scale", [0, 0.5], [[1, 1, 1], [1, -1, 1]], "STEP")


def rotation_cubic(b):
    a, c = about((1, 1, 0), 0, 100)
    keys = [[[0] * 4, a, [0.5, 0, 0.3, 0]], [[0, 0.4, 0, 0], c, [0] * 4]]
    b.clip(b.node(mesh=b.box()), "rotation", [0, 1], keys, "CUBICSPLINE")


def rotation_the_short_way(b):
    first, second = about((0, 1, 0), 10, 60)
    b.clip(b.node(mesh=b.box(b.picture())), "rotation", [0, 1], [first, [-x for x in second]])


def child_of_a_turning_parent(b):
    child = b.node(root=False, mesh=b.box(size=0.7), translation=[1, 0, 0])
    b.clip(b.node(children=[child]), "rotation", [0, 1], about((0, 1, 0), 0, 120))
    b.clip(child, "rotation", [0, 1], about((1, 0, 0), 0, -150))


def turning_below_unequal_scales(b):
    child = b.node(root=False, mesh=b.box())
    b.node(children=[child], scale=[0.5, 1.5, 1])
    b.clip(child, "rotation", [0, 1], about((0, 0, 1), 0, 90))


def second_node_stands(b):
    b.clip(b.node(mesh=b.box(size=0.8)), "translation", [0, 1], [[0, 0, 0], [1, 0, 0]])
    b.node(mesh=b.box(size=0.8), translation=[-1, 0, 0])


PLAYED = {
    "morph_weights": Model(
        lambda b: b.clip(
            b.node(mesh=bump(b, b.box()), scale=[1, 0.8, 1]), "weights", [0, 0.5, 1], [[0, 1], [1, 0], [0, 0]]
        ),
        ONCE,
    ),
    "morph_weights_cubic": Model(
        lambda b: b.clip(
            b.node(mesh=bump(b, b.box())),
            "weights",
            [0, 1],
            [[[0, 0], [0, 1], [1, 0]], [[2, 0], [1, 0], [0, 1]]],
            "CUBICSPLINE",
        ),
        ONCE,
    ),
    "skin_bends": Model(lambda b: b.clip(skinned(b)[1], "rotation", [0, 1], about((0, 0, 1), 0, 80)), ONCE),
    "skin_of_two_sets": Model(
        lambda b: b.clip(skinned(b, joints=6, sets=2)[5], "rotation", [0, 1], about((1, 0, 1), 0, 80)), ONCE
    ),
    "skin_mirrored": Model(
        lambda b: b.clip(skinned(b, scales={0: [1, 1, -1]})[1], "translation", [0, 1], [[0, 0.3, 0], [0.8, 0.3, 0]]),
        ONCE,
    ),
    "skin_with_a_hidden_joint": Model(
        lambda b: b.clip(skinned(b)[0], "scale", [0, 0.2, 1], [[0, 0, 0], [0.2, 0.2, 0.2], [1, 1, 1]]), ONCE, 0.6, 0.65
    ),
    "translation_linear": Model(
        lambda b: b.clip(
            b.node(mesh=b.box()),
            "translation",
            [0, 0.25, 0.5, 1],
            [[0, 0, 0], [0.5, 0, 0], [-0.4, 0.3, 0], [0, 0, 0]],
        ),
        ONCE,
    ),
    "rotation_linear": Model(
        lambda b: b.clip(b.node(mesh=b.box(b.picture())), "rotation", [0, 0.2, 1], about((1, 2, 3), 0, 50, 200)), ONCE
    ),
    "rotation_the_short_way": Model(rotation_the_short_way, ONCE),
    "rotation_of_fifty_turns_a_second": Model(
        lambda b: b.clip(
            b.node(mesh=b.box(b.picture())), "rotation", np.arange(401) / 400, about((0, 1, 0), *(45 * np.arange(401)))
        ),
        AnimationConfig(loop=True),
        7.3,
        7.3025,
        true=(0.3, 0.3025),
    ),
    "scale_linear": Model(lambda b: b.clip(b.node(mesh=b.box()), "scale", [0, 1], [[1, 1, 1], [0.3, 1.6, 1]]), ONCE),
    "scale_from_zero": Model(
        lambda b: b.clip(b.node(mesh=b.box(), scale=[0, 0, 0]), "scale", [0, 1], [[0, 0, 0], [2, 2, 2]]), ONCE
    ),
    "scale_through_zero": Model(scale_through_zero, ONCE, 0.7, 0.75),
    "scale_jumps_to_negative": Model(scale_jumps_to_negative, ONCE, 0.7, 0.75),
    "translation_step": Model(
        lambda b: b.clip(
            b.node(mesh=b.box()), "translation", [0, 0.5, 1], [[0, 0, 0], [0.4, 0.2, 0], [0, 0, 0]], "STEP"
        ),
        ONCE,
        0.49,
        0.51,
    ),
    "translation_cubic": Model(
        lambda b: b.clip(
            b.node(mesh=b.box()),
            "translation",
            [0, 1],
            [[[0, 0, 0], [0, 0, 0], [2, 0, 1]], [[0, 3, 0], [0.5, 0.2, 0], [0, 0, 0]]],
            "CUBICSPLINE",
        ),
        ONCE,
    ),
    "rotation_cubic": Model(rotation_cubic, ONCE),
    "first_key_later": Model(first_key_later, ONCE, 0.4, 0.9),
    "first_key_later_in_a_loop": Model(first_key_later, AnimationConfig(loop=True), 2.2, 2.8, true=(0.2, 0.8)),
    "played_backwards": Model(
        lambda b: b.clip(b.node(mesh=b.box()), "translation", [0, 0.3, 1], [[0.5, 0, 0], [0, 0.5, 0], [0.5, 0, 0]]),
        AnimationConfig(loop=True, speed=-1.5, phase=0.2),
        0.4,
        0.45,
        true=(0.6, 0.525),
    ),
    "child_of_a_turning_parent": Model(child_of_a_turning_parent, ONCE),
    "turning_below_unequal_scales": Model(turning_below_unequal_scales, ONCE),
    "moving_and_mirrored": Model(
        lambda b: b.clip(
            b.node(mesh=b.box(b.picture()), scale=[1, 1, -1.2]), "rotation", [0, 1], about((0, 1, 1), 0, 90)
        ),
        ONCE,
    ),
    "second_node_stands": Model(second_node_stands, ONCE),
}

MODELS = {name: Model(build) for name, build in STILL.items()} | PLAYED
