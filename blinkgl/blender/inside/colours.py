"""Base colours that glTF can say: one colour or one picture per material. Everything else a node tree makes is baked:
its colour is made to shine and Cycles writes that down, on texture coordinates of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import bpy
import numpy as np
from said import Table, names

UV = "BlinkGL bake"
_MOST_UVS = 8  # Blender's
_MOST_FACES = 400_000  # of a mesh that is unwrapped
_SAMPLES = 4  # per texel: edges of a pattern, nothing is noisy
_COLOUR_INPUTS = ("Base Color", "Color")
_SEEN_THROUGH = ("BSDF_TRANSPARENT", "HOLDOUT")
_SHINING = ("EMISSION", "BACKGROUND")
# What these give depends on who looks, or from where: baked, it is what one look would have seen.
_VIEW = ("LAYER_WEIGHT", "FRESNEL", "CAMERA", "LIGHT_PATH")


class Baking:
    """size : px of a side.   seconds : no further one is begun after so long."""

    def __init__(self, size: int, seconds: float, table: Table):
        self.size, self.seconds, self.table = size, seconds, table
        self.begun = time.monotonic()
        self.left_out: list[str] = []

    def late(self) -> bool:
        return time.monotonic() - self.begun > self.seconds


def make_plain(things: list[bpy.types.Object], baking: Baking, doing: Callable[[str], None]) -> None:
    """All materials of these meshes become what the exporter understands."""
    table = baking.table
    things = [o for o in things if o.type == "MESH"]
    _own_slots(things)
    used = {m.name_full: m for o in things for m in o.data.materials if m is not None}
    _without_missing_pictures(used.values(), table)
    kinds = {name: kind_of(material, table) for name, material in used.items()}
    row = table["materials"]
    row.found = row.came = len(used)
    for name, kind in kinds.items():
        if kind in ("plain", "picture"):
            _as_principled(used[name])
    counts = {"plain": "a plain colour", "picture": "a picture as it is", "none": "without a surface"}
    for kind, words in counts.items():
        if number := sum(k == kind for k in kinds.values()):
            row.notes.append(f"{number} {words}")
    to_bake = [name for name, kind in kinds.items() if kind == "baked"]
    done = _bake_all(things, {name: used[name] for name in to_bake}, baking, doing)
    if done:
        row.notes.append(f"{len(done)} baked to pictures of {baking.size} px: {names(done)}")
    if baking.left_out:
        row.notes.append(f"no time to bake {names(baking.left_out)}: in their plain colours")


def _own_slots(things: list[bpy.types.Object]) -> None:
    """Materials that belong to an object and not to its mesh: the mesh becomes the object's own."""
    for thing in things:
        if any(slot.link == "OBJECT" for slot in thing.material_slots):
            listed = [slot.material for slot in thing.material_slots]
            if thing.data.users > 1:
                thing.data = thing.data.copy()
            for k, material in enumerate(listed):
                thing.material_slots[k].link = "DATA"
                thing.data.materials[k] = material


# ------------------------------------------------------------------------------------------------------------- looking


def trees(tree: bpy.types.NodeTree | None) -> Iterator[bpy.types.NodeTree]:
    """A node tree and those of its groups, each once."""
    waiting, seen = [tree], set()
    while waiting:
        found = waiting.pop()
        if found is None or found.name_full in seen:
            continue
        seen.add(found.name_full)
        yield found
        waiting += [node.node_tree for node in found.nodes if node.type == "GROUP"]


def nodes(material: bpy.types.Material) -> Iterator[bpy.types.Node]:
    """All nodes of a material, its groups' too."""
    for tree in trees(material.node_tree if material.use_nodes else None):
        yield from tree.nodes


def missing(image: bpy.types.Image | None) -> bool:
    """No pixels: the file is not there, or no picture."""
    return image is None or (image.source != "GENERATED" and tuple(image.size) == (0, 0))


def _without_missing_pictures(materials, table: Table) -> None:
    row, gone, whole = table["pictures"], {}, {}
    for node in [n for material in materials for n in nodes(material) if n.type == "TEX_IMAGE"]:
        name = "none" if node.image is None else node.image.name
        if not missing(node.image):
            whole[name] = True
            continue
        if node.image is not None:
            gone[name] = bpy.path.abspath(node.image.filepath, library=node.image.library) or name
        for output in node.outputs:
            for link in list(output.links):
                node.id_data.links.remove(link)
    row.found, row.came = len(whole) + len(gone), len(whole)
    row.notes += [f"missing: {path} (done without)" for path in gone.values()]


def output_of(material: bpy.types.Material) -> bpy.types.Node | None:
    """The node that says what the surface is."""
    return material.node_tree.get_output_node("ALL") or material.node_tree.get_output_node("CYCLES")


def _source(socket: bpy.types.NodeSocket) -> bpy.types.NodeSocket | None:
    """The output that an input takes its value from, past reroutes; None where nothing is linked."""
    while socket.is_linked:
        origin = socket.links[0].from_socket
        if origin.node.type != "REROUTE":
            return origin
        socket = origin.node.inputs[0]
    return None


def _colour_input(node: bpy.types.Node) -> bpy.types.NodeSocket | None:
    return next((node.inputs[name] for name in _COLOUR_INPUTS if name in node.inputs), None)


def kind_of(material: bpy.types.Material, table: Table) -> str:
    """ "plain", "picture", "none" or "baked"; what else it asks for is noted."""
    if not material.use_nodes or material.node_tree is None:
        return "plain"
    out = output_of(material)
    if out is None:
        return "none"
    row = table["materials"]
    if out.inputs["Displacement"].is_linked:
        row.notes.append(f"displacement of '{material.name}' left out")
    if out.inputs["Volume"].is_linked:
        table["volumes"].found += 1
        table["volumes"].notes.append(f"inside of '{material.name}' left out")
    surface = _source(out.inputs["Surface"])
    if surface is None:
        return "none"
    animated = [tree for tree in trees(material.node_tree) if tree.animation_data is not None]
    if any(tree.animation_data.action or tree.animation_data.drivers for tree in animated):
        row.notes.append(f"'{material.name}' changes in time: as in the first frame")
    if any(node.type in _VIEW for node in nodes(material)):
        row.notes.append(f"'{material.name}' depends on the view: as seen from straight above each point")
    socket = _colour_input(surface.node) if surface.node.type != "GROUP" else None
    if socket is None:
        return "baked"
    origin = _source(socket)
    if origin is None:
        return "plain"
    return "picture" if _plain_picture(origin) else "baked"


def _plain_picture(origin: bpy.types.NodeSocket) -> bool:
    """What glTF says of a texture: one picture in sRGB on texture coordinates, scaled, turned and moved at most."""
    node = origin.node
    if node.type != "TEX_IMAGE" or origin.name != "Color" or node.projection != "FLAT":
        return False
    image = node.image
    if image.source not in ("FILE", "GENERATED") or image.colorspace_settings.name != "sRGB":
        return False
    vector = _source(node.inputs["Vector"])
    if vector is not None and vector.node.type == "MAPPING":
        if vector.node.vector_type not in ("POINT", "TEXTURE") or any(
            vector.node.inputs[key].is_linked for key in ("Location", "Rotation", "Scale") if key in vector.node.inputs
        ):
            return False
        vector = _source(vector.node.inputs["Vector"])
    return vector is None or vector.node.type == "UVMAP" or (vector.node.type == "TEX_COORD" and vector.name == "UV")


# ------------------------------------------------------------------------------------------------------------- making


def _as_principled(material: bpy.types.Material) -> None:
    """A diffuse, glossy, … surface by a node that the exporter knows; one that shines is drawn unlit."""
    if not material.use_nodes or material.node_tree is None:
        colour = tuple(material.diffuse_color)
        material.use_nodes = True
        out = output_of(material)
        if out is not None and (surface := _source(out.inputs["Surface"])) is not None:
            _colour_input(surface.node).default_value = colour
        return
    surface = _source(output_of(material).inputs["Surface"]).node
    if surface.type in ("BSDF_PRINCIPLED", "BACKGROUND"):
        return
    socket = _colour_input(surface)
    _replace_surface(material, _source(socket), tuple(socket.default_value), surface.type in _SHINING)


def _replace_surface(material, origin, colour: tuple, shining: bool) -> None:
    tree = material.node_tree
    shader = tree.nodes.new("ShaderNodeBackground" if shining else "ShaderNodeBsdfPrincipled")
    socket = _colour_input(shader)
    socket.default_value = colour
    if origin is not None:
        tree.links.new(origin, socket)
    tree.links.new(shader.outputs[0], output_of(material).inputs["Surface"])


class _Colours:
    """Adds to a material's tree what makes the colour of a surface out of its shaders."""

    def __init__(self) -> None:
        self.leaves: list[str] = []

    def of(self, tree, socket, parents: list) -> bpy.types.NodeSocket | None:
        """An output of ``tree`` with the colour of the shader that goes into ``socket``; None where there is none."""
        origin = _source(socket)
        if origin is None:
            return None
        node = origin.node
        if node.type == "MIX_SHADER":
            return self._mixed(tree, "MIX", node.inputs[0], *(self.of(tree, node.inputs[k], parents) for k in (1, 2)))
        if node.type == "ADD_SHADER":
            return self._mixed(tree, "ADD", None, *(self.of(tree, node.inputs[k], parents) for k in (0, 1)))
        if node.type == "GROUP" and node.node_tree is not None:
            node.node_tree = inner = node.node_tree.copy()
            end = next((n for n in inner.nodes if n.type == "GROUP_OUTPUT" and n.is_active_output), None)
            entry = None if end is None else _by_identifier(end.inputs, origin.identifier)
            found = None if entry is None else self.of(inner, entry, [*parents, (tree, node)])
            if found is None:
                return None
            made = inner.interface.new_socket("colour", in_out="OUTPUT", socket_type="NodeSocketColor")
            inner.links.new(found, _by_identifier(end.inputs, made.identifier))
            return _by_identifier(node.outputs, made.identifier)
        if node.type == "GROUP_INPUT" and parents:
            above, group = parents[-1]
            found = self.of(above, _by_identifier(group.inputs, origin.identifier), parents[:-1])
            if found is None:
                return None
            made = tree.interface.new_socket("colour", in_out="INPUT", socket_type="NodeSocketColor")
            above.links.new(found, _by_identifier(group.inputs, made.identifier))
            return _by_identifier(node.outputs, made.identifier)
        if node.type in _SEEN_THROUGH:
            return None
        entry = _colour_input(node)
        if entry is None:
            return None
        self.leaves.append(node.type)
        return _source(entry) or self._constant(tree, entry.default_value)

    @staticmethod
    def _constant(tree, value) -> bpy.types.NodeSocket:
        node = tree.nodes.new("ShaderNodeRGB")
        node.outputs[0].default_value = value
        return node.outputs[0]

    @staticmethod
    def _mixed(tree, how: str, factor, a, b) -> bpy.types.NodeSocket | None:
        if a is None or b is None:
            return a or b
        mix = tree.nodes.new("ShaderNodeMix")
        mix.data_type, mix.blend_type, mix.clamp_result = "RGBA", how, False
        inputs = {s.identifier: s for s in mix.inputs}
        tree.links.new(a, inputs["A_Color"])
        tree.links.new(b, inputs["B_Color"])
        if factor is None:
            inputs["Factor_Float"].default_value = 1.0
        elif (origin := _source(factor)) is not None:
            tree.links.new(origin, inputs["Factor_Float"])
        else:
            inputs["Factor_Float"].default_value = factor.default_value
        return next(s for s in mix.outputs if s.identifier == "Result_Color")


def _by_identifier(sockets, identifier: str) -> bpy.types.NodeSocket:
    return next(s for s in sockets if s.identifier == identifier)


# ------------------------------------------------------------------------------------------------------------- baking


def _bake_all(things, materials: dict, baking: Baking, doing) -> list[str]:
    """Names of the materials that were baked, on every mesh that has them."""
    done: dict[str, None] = {}
    per_mesh: dict[str, list[bpy.types.Object]] = {}
    for thing in things:
        if any(m is not None and m.name_full in materials for m in thing.data.materials):
            per_mesh.setdefault(thing.data.name_full, []).append(thing)
    if not per_mesh:
        return []
    settings = bpy.context.scene
    settings.render.engine = "CYCLES"
    settings.cycles.device, settings.cycles.samples = "CPU", _SAMPLES
    settings.cycles.use_denoising = settings.cycles.use_adaptive_sampling = settings.cycles.shading_system = False
    settings.render.bake.use_selected_to_active = False
    shown = {o.name_full: o.hide_render for o in bpy.data.objects}
    for thing in bpy.data.objects:
        thing.hide_render = True
    try:
        for owners in per_mesh.values():
            thing = owners[0]
            wanted = [m.name_full for m in thing.data.materials if m is not None and m.name_full in materials]
            doing(f"baking the colours of '{thing.name}'")
            if baking.late() or len(thing.data.polygons) > _MOST_FACES or len(thing.data.uv_layers) >= _MOST_UVS:
                baking.left_out += [name for name in wanted if name not in baking.left_out]
                _plain_colours(thing, materials)
                continue
            thing.hide_render = False
            _bake_mesh(thing, materials, baking.size)
            thing.hide_render = True
            done.update(dict.fromkeys(wanted))
    finally:
        for name, hidden in shown.items():
            bpy.data.objects[name].hide_render = hidden
    return list(done)


def _plain_colours(thing: bpy.types.Object, materials: dict) -> None:
    for k, material in enumerate(thing.data.materials):
        if material is not None and material.name_full in materials:
            plain = material.copy()
            shader = _source(output_of(plain).inputs["Surface"])
            socket = None if shader is None else _colour_input(shader.node)
            colour = tuple(plain.diffuse_color if socket is None else socket.default_value)
            _replace_surface(plain, None, colour, False)
            thing.data.materials[k] = plain


def _bake_mesh(thing: bpy.types.Object, materials: dict, size: int) -> None:
    """One picture for all of a mesh's materials that need one."""
    mesh = thing.data
    layer = _unwrap(thing)
    image = bpy.data.images.new(f"{mesh.name} colours", size, size, alpha=True)
    image.generated_color = (0.0, 0.0, 0.0, 0.0)  # what nothing is baked to keeps its alpha
    idle = bpy.data.images.new("idle", 8, 8)
    originals, made = list(mesh.materials), []
    for k, material in enumerate(originals):
        wanted = material is not None and material.name_full in materials
        baked = material.copy() if wanted else bpy.data.materials.new("idle") if material is None else material.copy()
        baked.use_nodes = True
        tree = baked.node_tree
        shining = False
        if wanted:
            colours = _Colours()
            out = output_of(baked)
            shader = tree.nodes.new("ShaderNodeEmission")
            found = colours.of(tree, out.inputs["Surface"], [])
            shining = bool(colours.leaves) and all(leaf in _SHINING for leaf in colours.leaves)
            if found is None:
                shader.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
            else:
                tree.links.new(found, shader.inputs["Color"])
            tree.links.new(shader.outputs[0], out.inputs["Surface"])
        target = tree.nodes.new("ShaderNodeTexImage")
        target.image = image if wanted else idle
        for node in tree.nodes:
            node.select = False
        target.select, tree.nodes.active = True, target
        mesh.materials[k] = baked
        made.append((k, material, baked, wanted, shining))
    _activate(thing)
    bpy.ops.object.bake(type="EMIT", margin=0, use_clear=False, target="IMAGE_TEXTURES", uv_layer=layer)
    pixels = np.empty((size, size, 4), np.float32)
    image.pixels.foreach_get(pixels.ravel())
    seen = pixels[..., 3] > 0.5
    if seen.any():
        pixels[..., :3] = filled(pixels[..., :3], seen)
    pixels[..., 3] = 1.0
    image.pixels.foreach_set(pixels.ravel())
    image.pack()
    # Nothing but one colour: no picture.
    even = pixels[..., :3].max(axis=(0, 1)) - pixels[..., :3].min(axis=(0, 1))
    plain = image_colour(pixels[0, 0, :3]) if (even <= 1.5 / 255).all() else None
    for k, material, baked, wanted, shining in made:
        mesh.materials[k] = material
        if wanted:
            mesh.materials[k] = _with_picture(material, image, layer, shining, plain)
        bpy.data.materials.remove(baked)
    bpy.data.images.remove(idle)


def filled(pixels: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(H, W, 3) with what was not ``seen`` (H, W) as its surroundings are, further away the coarser: mip levels then
    mix in nothing that is not on the surface."""
    if seen.all() or min(seen.shape) <= 1:
        return (
            pixels if seen.all() else np.where(seen[..., None], pixels, pixels[seen].mean(axis=0) if seen.any() else 0)
        )
    height, width = seen.shape
    even = np.pad(np.where(seen[..., None], pixels, 0.0), ((0, height % 2), (0, width % 2), (0, 0)))
    count = np.pad(seen, ((0, height % 2), (0, width % 2))).astype(np.float32)
    blocks = (even.shape[0] // 2, 2, even.shape[1] // 2, 2)
    total, number = even.reshape(*blocks, 3).sum(axis=(1, 3)), count.reshape(blocks).sum(axis=(1, 3))
    coarse = filled(total / np.maximum(number, 1)[..., None], number > 0)
    there = coarse.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(seen[..., None], pixels, there)


def image_colour(texel: np.ndarray) -> tuple[float, ...]:
    """Linear colour (with alpha 1) of a texel in sRGB."""
    c = np.asarray(texel, float)
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return (*(float(v) for v in linear), 1.0)


def _with_picture(material, image, layer: str, shining: bool, plain: tuple | None) -> bpy.types.Material:
    """A copy of the material whose colour is the picture, or plain; a principled surface keeps the rest of itself."""
    painted = material.copy()
    painted.name = f"{material.name} baked"
    tree = painted.node_tree
    if plain is not None:
        _replace_surface(painted, None, plain, shining)
        return painted
    picture, coordinates = tree.nodes.new("ShaderNodeTexImage"), tree.nodes.new("ShaderNodeUVMap")
    picture.image, coordinates.uv_map = image, layer
    tree.links.new(coordinates.outputs["UV"], picture.inputs["Vector"])
    surface = _source(output_of(painted).inputs["Surface"]).node
    if surface.type == "BSDF_PRINCIPLED":
        tree.links.new(picture.outputs["Color"], surface.inputs["Base Color"])
    else:
        _replace_surface(painted, picture.outputs["Color"], (1.0, 1.0, 1.0, 1.0), shining)
    return painted


def _activate(thing: bpy.types.Object) -> None:
    for other in bpy.context.view_layer.objects:
        other.select_set(False)
    thing.select_set(True)
    bpy.context.view_layer.objects.active = thing


def _unwrap(thing: bpy.types.Object) -> str:
    """Name of a new layer of texture coordinates on which no two faces lie on each other."""
    before = (
        thing.data.uv_layers.active_index,
        next((k for k, u in enumerate(thing.data.uv_layers) if u.active_render), 0),
    )
    made = thing.data.uv_layers.new(name=UV)
    name = made.name
    thing.data.uv_layers.active = made
    _activate(thing)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.reveal()
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.uv.smart_project(island_margin=0.003, margin_method="ADD")
    bpy.ops.object.mode_set(mode="OBJECT")
    if len(thing.data.uv_layers) > 1:  # what other nodes take when they name no layer
        thing.data.uv_layers.active_index = before[0]
        thing.data.uv_layers[before[1]].active_render = True
    return name
