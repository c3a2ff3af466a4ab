"""Small glTF files, one a feature, named after Khronos' sample models and glTF-Asset-Generator. Each function adds to a
builder what its name says; ``PLAYED`` has the clips that are played, with the time at which they are looked at."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
from PIL import Image

from tests.scene.gltf_files import GltfBuilder

MODELS: dict[str, Callable[[Models], None]] = {}
PLAYED: dict[str, dict] = {}
HALF = np.sqrt(0.5)
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)


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
        number = self.array(np.asarray(values, dtype), kind)
        self.tree["accessors"][number].update(more)
        return number

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

    def box(self, material=None, size=1.6, **attributes):
        points, faces, normals, uvs = cube(size)
        number = self.mesh(points, faces, normals, uvs, self.colour() if material is None else material)
        self.tree["meshes"][number]["primitives"][0]["attributes"].update(attributes)
        return number

    def square(self, material=None, faces=((0, 1, 2), (0, 2, 3)), **more):
        number = self.mesh(
            SQUARE, faces, uvs=(SQUARE[:, :2] + 1) / 2, material=self.colour() if material is None else material
        )
        self.tree["meshes"][number]["primitives"][0].update(more)
        return number

    def clip(self, node, path, times, values, kind="LINEAR"):
        widths = {"rotation": "VEC4", "weights": "SCALAR"}
        values = np.asarray(values, float)
        values = values.reshape(-1, 1) if path == "weights" else values.reshape(-1, values.shape[-1])
        sampler = {"input": self.add(times, "SCALAR"), "output": self.add(values, widths.get(path, "VEC3"))}
        (animation,) = self.tree.setdefault("animations", [{"channels": [], "samplers": []}])
        animation["samplers"].append({**sampler, "interpolation": kind})
        animation["channels"].append(
            {"sampler": len(animation["samplers"]) - 1, "target": {"node": node, "path": path}}
        )

    def use(self, *names, root=None):
        self.tree["extensionsUsed"] = list(names)
        self.tree["extensionsRequired"] = list(names)
        self.tree.update({"extensions": root} if root else {})


def model(function):
    MODELS[function.__name__] = function
    return function


def played(at=0.3, to=0.36, loop=False, speed=1.0, phase=0.0, true=None):
    """true : time of the clip that is seen at ``at`` and the one at ``to``, where they differ."""

    def mark(function):
        PLAYED[function.__name__] = {
            "at": at,
            "to": to,
            "loop": loop,
            "speed": speed,
            "phase": phase,
            "true": true or (at, to),
        }
        return model(function)

    return mark


def about(axis, *angles):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return [[*(axis * np.sin(np.radians(a) / 2)), np.cos(np.radians(a) / 2)] for a in angles]


# ---- geometry
@model
def triangle_without_indices(b):
    b.tree["meshes"] = [
        {"primitives": [{"attributes": {"POSITION": b.add(SQUARE[:3], "VEC3")}, "material": b.colour()}]}
    ]
    b.node(mesh=0, rotation=about((1, 0, 0), -70)[0])


def strip(b, mode, order, **more):
    attributes = {"POSITION": b.add(SQUARE, "VEC3")}
    primitive = {"attributes": attributes, "mode": mode, "material": b.colour()}
    if order is not None:
        primitive["indices"] = b.add(np.array(order)[:, None], "SCALAR", "u2")
    b.tree["meshes"] = [{"primitives": [primitive]}]
    b.node(mesh=0, **{"rotation": about((1, 0, 0), -50)[0], **more})


@model
def triangle_strip(b):
    strip(b, 5, [0, 1, 3, 2])


@model
def triangle_strip_without_indices(b):
    b.tree["meshes"] = [
        {
            "primitives": [
                {"attributes": {"POSITION": b.add(SQUARE[[0, 1, 3, 2]], "VEC3")}, "mode": 5, "material": b.colour()}
            ]
        }
    ]
    b.node(mesh=0, rotation=about((1, 0, 0), -50)[0])


@model
def triangle_fan(b):
    strip(b, 6, [2, 3, 0, 1])


@model
def triangle_fan_mirrored(b):
    strip(b, 6, [2, 3, 0, 1], scale=[1, 1, -1], rotation=about((1, 0, 0), 130)[0])


@model
def box(b):
    b.node(mesh=b.box())


@model
def box_without_normals_is_flat(b):
    points = np.array(
        [[np.cos(a), h, np.sin(a)] for a in np.linspace(0, 2 * np.pi, 16, endpoint=False) for h in (-1, 1)]
    )
    faces = [[2 * k, 2 * k + 1, (2 * k + 3) % 32] for k in range(16)] + [
        [2 * k, (2 * k + 3) % 32, (2 * k + 2) % 32] for k in range(16)
    ]
    b.node(mesh=b.mesh(points, faces, material=b.colour()))


@model
def points_and_lines_beside_a_box(b):
    number = b.box()
    b.tree["meshes"][number]["primitives"] += [{"attributes": {"POSITION": 0}, "mode": mode} for mode in (0, 1, 2, 3)]
    b.node(mesh=number)


@model
def interleaved(b):
    points, faces, normals, _ = cube()
    view = b.view(np.hstack([points, normals]).astype("f4").tobytes())
    b.tree["bufferViews"][view]["byteStride"] = 24
    for offset in (0, 12):
        b.tree["accessors"].append(
            {"bufferView": view, "byteOffset": offset, "componentType": 5126, "count": 24, "type": "VEC3"}
        )
    indices = b.add(faces.reshape(-1, 1), "SCALAR", "u1")
    b.tree["meshes"] = [
        {"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1}, "indices": indices, "material": b.colour()}]}
    ]
    b.node(mesh=0)


@model
def sparse_accessor(b):
    number = b.box()
    at, new = b.view(np.array([3, 8], "u2").tobytes()), b.view(np.array([[0.2, 1.4, 0.3], [1, 1, 1.0]], "f4").tobytes())
    b.tree["accessors"][0]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": at, "componentType": 5123},
        "values": {"bufferView": new},
    }
    b.node(mesh=number)


@model
def sparse_without_a_buffer(b):
    at, new = b.view(np.array([1, 2], "u1").tobytes()), b.view(np.array([[1.5, 0, 0], [0, 1.5, 0]], "f4").tobytes())
    sparse = {"count": 2, "indices": {"bufferView": at, "componentType": 5121}, "values": {"bufferView": new}}
    b.tree["accessors"].append({"componentType": 5126, "count": 3, "type": "VEC3", "sparse": sparse})
    b.tree["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0}, "material": b.colour(doubleSided=True)}]}]
    b.node(mesh=0)


@model
def quantised_mesh(b):
    b.use("KHR_mesh_quantization")
    points, faces, normals, _ = cube(2)
    view = b.view(np.column_stack([points * 100, points[:, :1] * 0]).astype("i2").tobytes())
    b.tree["bufferViews"][view]["byteStride"] = 8
    b.tree["accessors"].append({"bufferView": view, "componentType": 5122, "count": 24, "type": "VEC3"})
    view = b.view(np.column_stack([normals * 127, points[:, :1] * 0]).astype("i1").tobytes())
    b.tree["bufferViews"][view]["byteStride"] = 4
    b.tree["accessors"].append(
        {"bufferView": view, "componentType": 5120, "normalized": True, "count": 24, "type": "VEC3"}
    )
    primitive = {
        "attributes": {"POSITION": 0, "NORMAL": 1},
        "indices": b.add(faces.reshape(-1, 1), "SCALAR", "u2"),
        "material": b.colour(),
    }
    b.tree["meshes"] = [{"primitives": [primitive]}]
    b.node(mesh=0, scale=[0.008] * 3)


@model
def two_primitives(b):
    one, other = b.box(), b.square(b.colour(0.1, 0.2, 0.9, 1, doubleSided=True))
    b.tree["meshes"][one]["primitives"] += b.tree["meshes"].pop(other)["primitives"]
    b.node(mesh=one, rotation=about((0, 1, 0), 25)[0])


# ---- sides
@model
def single_sided_from_behind(b):
    b.node(mesh=b.square(), rotation=about((0, 1, 0), 180)[0], translation=[0, 0, 0])
    b.node(mesh=b.box(size=0.7), translation=[1, 0, 0])


@model
def double_sided_from_behind(b):
    b.node(mesh=b.square(b.colour(doubleSided=True)), rotation=about((0, 1, 0), 180)[0])


@model
def room_around_the_camera(b):
    points, faces, normals, uvs = cube(12)
    b.node(mesh=b.mesh(points, faces[:, ::-1], -normals, uvs, b.picture()))


@model
def box_around_the_camera(b):
    """Single-sided and facing outwards: nothing of it is seen from inside."""
    b.node(mesh=b.box(size=12))
    b.node(mesh=b.box(size=1))


@model
def dome(b):
    points, faces, normals, uvs = cube(1.5)
    b.node(mesh=b.mesh(points, faces[2:, ::-1], -normals, uvs, b.colour()))


@model
def open_box_double_sided(b):
    points, faces, normals, uvs = cube(1.5)
    b.node(mesh=b.mesh(points, faces[:10], normals, uvs, b.colour(doubleSided=True)), rotation=about((1, 1, 0), 200)[0])


# ---- nodes
@model
def negative_scale(b):
    b.node(mesh=b.box(b.picture()), scale=[-1, 1, 1.3], translation=[0.2, 0, 0])


@model
def negative_scale_twice(b):
    b.node(mesh=b.box(b.picture()), scale=[-1, -1, 1.2])


@model
def negative_scale_of_a_parent(b):
    child = b.node(root=False, mesh=b.square(), rotation=about((1, 0, 0), -60)[0])
    b.node(children=[child], scale=[1, 1, -1])
    b.node(mesh=b.box(size=0.6), translation=[1.2, 0, 0])


@model
def node_matrix(b):
    b.node(mesh=b.box(), matrix=[0.7, 0, 0.7, 0, 0, 1.2, 0, 0, -0.7, 0.3, 0.7, 0, 0.1, 0.2, 0, 1])


@model
def node_matrix_mirrored(b):
    b.node(mesh=b.box(b.picture()), matrix=[0.7, 0, 0.7, 0, 0, -1.2, 0, 0, -0.7, 0.3, 0.7, 0, 0.1, 0.2, 0, 1])


@model
def scale_of_zero(b):
    b.node(mesh=b.box())
    b.node(mesh=b.box(size=3), scale=[0, 0, 0])


@model
def scale_of_zero_of_a_parent(b):
    b.node(mesh=b.box())
    b.node(scale=[0, 0, 0], children=[b.node(root=False, mesh=b.box(size=3))])


@model
def flat_scale(b):
    b.node(mesh=b.square(b.colour(doubleSided=True)), scale=[1, 1, 0], rotation=about((0, 1, 0), 30)[0])


@model
def small_scale(b):
    b.node(scale=[1e-4] * 3, children=[b.node(root=False, mesh=b.box(size=1.6e4))])


@model
def unequal_scales(b):
    b.node(mesh=b.box(), scale=[0.4, 1.5, 1], rotation=about((1, 2, 0), 40)[0])


@model
def shear(b):
    child = b.node(root=False, mesh=b.box(), rotation=about((0, 0, 1), 40)[0])
    b.node(children=[child], scale=[0.5, 1.4, 1])


@model
def hidden_node(b):
    b.use("KHR_node_visibility")
    b.node(mesh=b.box())
    hidden = b.node(root=False, mesh=b.box(size=3))
    b.node(children=[hidden], extensions={"KHR_node_visibility": {"visible": False}})


@model
def one_mesh_at_many_nodes(b):
    mesh = b.box(size=0.5)
    for k in range(5):
        b.node(mesh=mesh, translation=[k * 0.6 - 1.2, 0.2 * k, 0], rotation=about((1, k, 0), 30 * k)[0])


@model
def second_scene(b):
    b.node(mesh=b.box(size=3))
    shown = b.node(root=False, mesh=b.box())
    b.tree["scenes"].append({"nodes": [shown]})
    b.tree["scene"] = 1


# ---- materials
@model
def vertex_colours(b):
    tint = np.random.default_rng(1).random((24, 3))
    b.node(mesh=b.box(b.colour(1, 1, 1, 1), COLOR_0=b.add(tint, "VEC3")))


@model
def vertex_colours_of_bytes(b):
    tint = np.random.default_rng(2).integers(0, 256, (24, 4))
    b.node(mesh=b.box(b.colour(0.5, 1, 1, 1), COLOR_0=b.add(tint, "VEC4", "u1", normalized=True)))


@model
def vertex_colours_of_shorts(b):
    tint = np.column_stack([np.random.default_rng(3).integers(0, 65536, (24, 3)), np.zeros(24)])
    b.node(mesh=b.box(b.colour(1, 1, 1, 1), COLOR_0=b.add(tint, "VEC4", "u2", normalized=True)))


@model
def textured(b):
    b.node(mesh=b.box(b.picture()))


@model
def textured_by_webp(b):
    b.use("EXT_texture_webp")
    b.node(mesh=b.box(b.picture("WEBP", texture={"extensions": {"EXT_texture_webp": {"source": 0}}})))


@model
def texture_coordinates_of_shorts(b):
    b.node(mesh=b.box(b.picture(), TEXCOORD_0=b.add(cube()[3] * 65535, "VEC2", "u2", normalized=True)))


@model
def texture_transform(b):
    b.use("KHR_texture_transform")
    place = {"offset": [0.25, 0.5], "rotation": 0.4, "scale": [0.7, 1.5]}
    b.node(mesh=b.box(b.picture(info={"extensions": {"KHR_texture_transform": place}})))


@model
def second_texture_coordinates(b):
    number = b.box(b.picture(info={"texCoord": 1}), TEXCOORD_1=b.add(cube()[3][:, ::-1], "VEC2"))
    b.tree["meshes"][number]["primitives"][0]["_set"] = 1
    b.node(mesh=number)


@model
def texture_clamped(b):
    b.node(
        mesh=b.box(b.picture(sampler={"wrapS": 33071, "wrapT": 33071}), TEXCOORD_0=b.add(cube()[3] * 2 - 0.5, "VEC2"))
    )


@model
def texture_mirrored(b):
    b.node(
        mesh=b.box(
            b.picture(sampler={"wrapS": 33648, "wrapT": 10497}), TEXCOORD_0=b.add(cube()[3] * 2.5 - 0.75, "VEC2")
        )
    )


@model
def material_variants(b):
    b.use("KHR_materials_variants", root={"KHR_materials_variants": {"variants": [{"name": "blue"}]}})
    number = b.box()
    mapping = {"KHR_materials_variants": {"mappings": [{"material": b.colour(0, 0, 1, 1), "variants": [0]}]}}
    b.tree["meshes"][number]["primitives"][0]["extensions"] = mapping
    b.node(mesh=number)


@model
def masked(b):
    alpha = [[255, 255, 0, 255], [0, 255, 255, 255], [255, 0, 255, 0], [255, 255, 255, 0]]
    b.node(mesh=b.box(b.picture(alpha=alpha, alphaMode="MASK")))


@model
def masked_everywhere(b):
    b.node(mesh=b.box(b.colour(1, 0, 0, 0.3, alphaMode="MASK"), size=3))
    b.node(mesh=b.box(size=1))


@model
def no_material(b):
    number = b.box()
    del b.tree["meshes"][number]["primitives"][0]["material"]
    b.node(mesh=number)


# ---- shapes that change
def bump(b, number, **more):
    points, _, normals, _ = cube()
    moved = points * [0.5, 0, 0] + [0.2, 0.4, 0]
    target = {"POSITION": b.add(moved, "VEC3"), "NORMAL": b.add(normals * 0, "VEC3")}
    b.tree["meshes"][number]["primitives"][0]["targets"] = [target, {"POSITION": b.add(points * [0, 0, 0.6], "VEC3")}]
    b.tree["meshes"][number].update(more)
    return number


@model
def morphed_at_rest(b):
    b.node(mesh=bump(b, b.box(), weights=[0.7, 0.2]))


@model
def morphed_by_its_node(b):
    b.node(mesh=bump(b, b.box(), weights=[0.7, 0.2]), weights=[0.1, 1])


@played()
def morph_weights(b):
    b.clip(b.node(mesh=bump(b, b.box()), scale=[1, 0.8, 1]), "weights", [0, 0.5, 1], [[0, 1], [1, 0], [0, 0]])


@played()
def morph_weights_cubic(b):
    keys = np.array([[[0, 0], [0, 1], [1, 0]], [[2, 0], [1, 0], [0, 1]]])
    b.clip(b.node(mesh=bump(b, b.box())), "weights", [0, 1], keys, "CUBICSPLINE")


def skinned(b, joints=2, sets=1, node=None, scales=None, **more):
    """A box whose lower half follows the first joint and whose upper half the last."""
    points = cube()[0]
    ids, weights = np.zeros((24, 4 * sets), int), np.zeros((24, 4 * sets))
    high = points[:, 1] > 0
    ids[high, -1], weights[high, -1], weights[~high, 0] = joints - 1, 1, 1
    given = {}
    for k in range(sets):
        given[f"JOINTS_{k}"] = b.add(ids[:, 4 * k : 4 * k + 4], "VEC4", "u1")
        given[f"WEIGHTS_{k}"] = b.add(weights[:, 4 * k : 4 * k + 4], "VEC4")
    number, bind = b.box(**given), np.tile(np.eye(4), (joints, 1, 1))
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


@model
def skin_at_rest(b):
    skinned(b, scales={1: [1.3, 1, 1]})


@model
def skin_whose_node_is_elsewhere(b):
    skinned(b, node={"translation": [9, 9, 9], "scale": [3, 3, 3]})


@model
def skin_mirrored_at_rest(b):
    skinned(b, scales={0: [-1, 1, 1]})


@played()
def skin_bends(b):
    b.clip(skinned(b)[1], "rotation", [0, 1], about((0, 0, 1), 0, 80))


@played()
def skin_of_two_sets(b):
    b.clip(skinned(b, joints=6, sets=2)[5], "rotation", [0, 1], about((1, 0, 1), 0, 80))


@played()
def skin_mirrored(b):
    b.clip(skinned(b, scales={0: [1, 1, -1]})[1], "translation", [0, 1], [[0, 0.3, 0], [0.8, 0.3, 0]])


@played(at=0.6, to=0.65)
def skin_with_a_hidden_joint(b):
    b.clip(skinned(b)[0], "scale", [0, 0.2, 1], [[0, 0, 0], [0.2, 0.2, 0.2], [1, 1, 1]])


# ---- clips
@played()
def translation_linear(b):
    b.clip(b.node(mesh=b.box()), "translation", [0, 0.25, 0.5, 1], [[0, 0, 0], [0.5, 0, 0], [-0.4, 0.3, 0], [0, 0, 0]])


@played()
def rotation_linear(b):
    b.clip(b.node(mesh=b.box(b.picture())), "rotation", [0, 0.2, 1], about((1, 2, 3), 0, 50, 200))


@played()
def rotation_the_short_way(b):
    first, second = about((0, 1, 0), 10, 60)
    b.clip(b.node(mesh=b.box(b.picture())), "rotation", [0, 1], [first, [-x for x in second]])


@played(at=7.3, to=7.3025, loop=True, true=(0.3, 0.3025))
def rotation_of_fifty_turns_a_second(b):
    b.clip(b.node(mesh=b.box(b.picture())), "rotation", np.arange(401) / 400, about((0, 1, 0), *(45 * np.arange(401))))


@played()
def scale_linear(b):
    b.clip(b.node(mesh=b.box()), "scale", [0, 1], [[1, 1, 1], [0.3, 1.6, 1]])


@played()
def scale_from_zero(b):
    b.clip(b.node(mesh=b.box(), scale=[0, 0, 0]), "scale", [0, 1], [[0, 0, 0], [2, 2, 2]])


@played(at=0.7, to=0.75)
def scale_through_zero(b):
    b.clip(b.node(mesh=b.box(b.picture())), "scale", [0, 1], [[1, 1, 1], [-1, 1, 1]])
    b.node(mesh=b.square(), translation=[0, 0, -1.5])


@played(at=0.7, to=0.75)
def scale_jumps_to_negative(b):
    b.clip(
        b.node(mesh=b.square(), rotation=about((1, 0, 0), -60)[0]), "scale", [0, 0.5], [[1, 1, 1], [1, 1, -1]], "STEP"
    )
    b.clip(b.node(mesh=b.box(b.picture(), size=0.8)), "scale", [0, 0.5], [[1, 1, 1], [1, -1, 1]], "STEP")


@played(at=0.49, to=0.51)
def translation_step(b):
    b.clip(b.node(mesh=b.box()), "translation", [0, 0.5, 1], [[0, 0, 0], [0.4, 0.2, 0], [0, 0, 0]], "STEP")


@played()
def translation_cubic(b):
    keys = [[[0, 0, 0], [0, 0, 0], [2, 0, 1]], [[0, 3, 0], [0.5, 0.2, 0], [0, 0, 0]]]
    b.clip(b.node(mesh=b.box()), "translation", [0, 1], keys, "CUBICSPLINE")


@played()
def rotation_cubic(b):
    a, c = about((1, 1, 0), 0, 100)
    b.clip(
        b.node(mesh=b.box()),
        "rotation",
        [0, 1],
        [[[0] * 4, a, [0.5, 0, 0.3, 0]], [[0, 0.4, 0, 0], c, [0] * 4]],
        "CUBICSPLINE",
    )


@played(at=0.4, to=0.9)
def first_key_later(b):
    b.clip(b.node(mesh=b.box()), "translation", [0.5, 1], [[0.5, 0, 0], [0, 0.5, 0]])


@played(at=2.2, to=2.8, loop=True, true=(0.2, 0.8))
def first_key_later_in_a_loop(b):
    b.clip(b.node(mesh=b.box()), "translation", [0.5, 1], [[0.5, 0, 0], [0, 0.5, 0]])


@played(at=0.4, to=0.45, loop=True, speed=-1.5, phase=0.2, true=(0.6, 0.525))
def played_backwards(b):
    b.clip(b.node(mesh=b.box()), "translation", [0, 0.3, 1], [[0.5, 0, 0], [0, 0.5, 0], [0.5, 0, 0]])


@played()
def child_of_a_turning_parent(b):
    child = b.node(root=False, mesh=b.box(size=0.7), translation=[1, 0, 0])
    parent = b.node(children=[child])
    b.clip(parent, "rotation", [0, 1], about((0, 1, 0), 0, 120))
    b.clip(child, "rotation", [0, 1], about((1, 0, 0), 0, -150))


@played()
def turning_below_unequal_scales(b):
    child = b.node(root=False, mesh=b.box())
    b.node(children=[child], scale=[0.5, 1.5, 1])
    b.clip(child, "rotation", [0, 1], about((0, 0, 1), 0, 90))


@played()
def moving_and_mirrored(b):
    b.clip(b.node(mesh=b.box(b.picture()), scale=[1, 1, -1.2]), "rotation", [0, 1], about((0, 1, 1), 0, 90))


@played()
def second_node_stands(b):
    b.clip(b.node(mesh=b.box(size=0.8)), "translation", [0, 1], [[0, 0, 0], [1, 0, 0]])
    b.node(mesh=b.box(size=0.8), translation=[-1, 0, 0])
