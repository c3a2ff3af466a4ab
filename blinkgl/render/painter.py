"""OpenGL state while passes are drawn: programs and their uniforms, clearing, culling, draw calls."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import moderngl
import numpy as np

from blinkgl.gl import GLContext, Target
from blinkgl.gl.shader import Uniforms
from blinkgl.machine.compiling import working_clock
from blinkgl.render.lens import Lens
from blinkgl.render.lighting import Lighting
from blinkgl.render.line_drawer import LineDrawer
from blinkgl.render.moment import Moment, linear_xyw_bytes
from blinkgl.scene.types import Map, Scene
from blinkgl.types.recent import Kept

if TYPE_CHECKING:
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.resources import SceneResources

FREE_UNIT = 8
"""First texture unit that a shape may use; a pass uses those below for a material and its inputs."""
MATERIAL_UNITS = {
    name: 16 + k
    for k, name in enumerate(
        ("coverage", "emission_map", "bumps", "gloss_map", "energy", "looks", "surroundings", "surrounding_luminance")
    )
}
"""Texture units of a material's maps besides the base colour."""


@dataclass
class RenderStats:
    """Wall seconds since the renderer was made; triangles submitted after culling."""

    frames: int = 0
    triangles: int = 0
    render_s: float = 0.0
    readback_s: float = 0.0


class Painter:
    """Draws for the passes of one renderer. A subclass may observe: each method is called only by passes.

    gl : GLContext.   resources : SceneResources.   stats : counters.   lens : of a camera with distortion.
    line_drawer : of the filtered edges."""

    def __init__(self, gl: GLContext, scene: Scene, resources: SceneResources, stats: RenderStats):
        self.gl, self.scene, self.resources, self.stats = gl, scene, resources, stats
        self.lighting = Lighting(scene.light)
        self.lens: Lens | None = None
        self.programs: Kept[Hashable, dict[Kind, Uniforms]] = Kept()
        self._covers: Kept[Hashable, tuple[Uniforms, moderngl.VertexArray]] = Kept()
        self._side = 0
        self.line_drawer = LineDrawer(gl, self.uniforms)

    def begin(self, target: Target, background: tuple[float, ...] = ()) -> None:
        """Set ``target`` for drawing and clear it: the first attachment to ``background`` (0 for missing components),
        the others to 0."""
        self.prepare(target)
        target.clear(*((*background, 0.0, 0.0, 0.0, 0.0)[: pixel.components] for pixel in target.formats[:1]))
        self.stats.frames += 1

    def prepare(self, target: Target) -> None:
        """Make ``target`` the one that is drawn to, and keep its content."""
        ctx = self.gl.ctx
        target.use()
        ctx.enable_only(moderngl.DEPTH_TEST)
        ctx.depth_func = ">"
        # Reversed depth: 1 at the near plane, so larger is nearer.
        ctx.front_face = "cw"  # counter-clockwise meshes in an image whose y points down
        self._side = 0

    def uniforms(self, program: moderngl.Program) -> Uniforms:
        """Return the table of uniforms that a pass sets."""
        return Uniforms(program)

    def ready(self, uniforms: Uniforms, moment: Moment, size: tuple[int, int]) -> None:
        """Set the uniforms that all items of a picture share: at each picture anew, since the context's programs, with
        their uniforms, are shared with other renderers."""
        if "light_strength" in uniforms:
            light, factor = self.scene.light, moment.factor(self.scene.light.over_time)
            uniforms["light_strength"].value = (light.sun * factor, light.sky * factor)
        if "fog" in uniforms:
            self.fog(uniforms, moment, size)

    def place(self, uniforms: Uniforms, item: DrawItem, moment: Moment) -> None:
        """Set the uniforms of every program that draws the scene: matrices, depths and, if it has them, the light."""
        index = item.object_index
        uniforms["mvp"].write(moment.mvp_columns[index])
        if "inverse_depths" in uniforms:
            uniforms["inverse_depths"].write(moment.inverse_depths[item.number])
        if "sun_direction" in uniforms:
            sun, up = self.lighting.directions(moment)
            uniforms["sun_direction"].write(sun[index])
            uniforms["up_direction"].write(up[index])
        else:
            self.lighting.place(uniforms, item, moment)
        if item.extended:
            self._dress(uniforms, item, moment)

    def _dress(self, uniforms: Uniforms, item: DrawItem, moment: Moment) -> None:
        """Set a material's uniforms besides the base colour."""
        material, resources = item.material, self.resources
        # A program has only the uniforms of its variant: what is not there is not used by it.
        if "coverage" in uniforms and material.mask is not None:
            self._look_up(uniforms, "coverage", resources.coverage_texture(material))
            uniforms["cutoff"].value = material.mask.threshold
        if "tint_shares" in uniforms:
            uniforms["tint_shares"].value = tuple(self.lighting.channel(material.base_color))
        if "emission" in uniforms:
            colour = uniforms["emission"].dimension == 3
            factor = moment.factor(material.emission_over_time, item.part)
            uniforms["emission"].value = (
                tuple(factor * c for c in material.emission)
                if colour
                else factor * resources.emitted_luminance(material)
            )
            if "emission_map" in uniforms and material.emission_map is not None:
                self._look_up(
                    uniforms, "emission_map", resources.emission_texture(material, colour), material.emission_map
                )
        if "bumps" in uniforms and material.bumps is not None:
            self._look_up(uniforms, "bumps", resources.numbers_texture(material.bumps), material.bumps)
            uniforms["bump_scale"].value = material.bump_scale
        if "gloss" in uniforms and (gloss := material.gloss) is not None:
            self._shine(uniforms, item, moment)
            uniforms["gloss"].value = gloss.metallic, gloss.roughness
            if "gloss_map" in uniforms and gloss.map is not None:
                self._look_up(uniforms, "gloss_map", resources.numbers_texture(gloss.map), gloss.map)

    def _shine(self, uniforms: Uniforms, item: DrawItem, moment: Moment) -> None:
        """Set the uniforms of reflections and the position of the camera."""
        self._look_up(uniforms, "energy", self.resources.energy_texture())
        self._look_up(uniforms, "looks", self.resources.looks_texture())
        coloured = "surroundings" in uniforms
        name = "surroundings" if coloured else "surrounding_luminance"
        self._look_up(uniforms, name, self.resources.surroundings_texture(coloured))
        if "around_factor" in uniforms:
            uniforms["around_factor"].value = moment.factor(self.scene.light.over_time)
        pose = moment.T_world_obj[item.object_index]
        # The camera's centre in the object's axes, R^T (camera - object).
        R, away = pose[:3, :3], moment.T_world_cam[:3, 3] - pose[:3, 3]
        uniforms["eye"].value = tuple(away @ R)
        uniforms["to_world"].write(np.ascontiguousarray(R.T, np.float32).tobytes())
        if "eye_rate" in uniforms:
            # The product rule on R^T (camera - object).
            rate = moment.rates.T_world_obj[item.object_index]
            dR, moving = rate[:3, :3], moment.dT_world_cam[:3, 3] - rate[:3, 3]
            uniforms["eye_rate"].value = tuple(away @ dR + moving @ R)
            uniforms["to_world_rate"].write(np.ascontiguousarray(dR.T, np.float32).tobytes())

    def _look_up(self, uniforms: Uniforms, name: str, texture: Any, map_: Map | None = None) -> None:
        """Bind a material's texture, and set the transform of its coordinates."""
        unit = MATERIAL_UNITS[name]
        texture.use(unit)
        uniforms[name].value = unit
        if map_ is not None:
            # A 2x3 affine map as GLSL stores it, column by column.
            a, b, c, d, e, f = map_.at
            uniforms[f"{name}_place"].value = (a, d, b, e, c, f)

    def deform(self, uniforms: Uniforms, item: DrawItem, moment: Moment, ends: Mapping[str, Moment]) -> None:
        """Set the further uniforms of a deforming shape's vertex stage; call it after :meth:`place`. ends : moments at
        other times, by name."""
        index, deformer = item.object_index, item.deformer
        assert deformer is not None
        shape, t_ns = self.resources.shape(deformer), moment.t_ns
        shape.put("now", t_ns, partial(deformer.numbers, t_ns))
        if "clip_rate" in uniforms:
            shape.put("rate", t_ns, partial(deformer.rates, t_ns))
            uniforms["clip_rate"].write(linear_xyw_bytes(moment.mvp[index]))
        for towards, there in ends.items():
            if f"clip_{towards}" in uniforms:
                shape.put(towards, (t_ns, there.t_ns), partial(deformer.changes, t_ns, there.t_ns))
                uniforms[f"clip_{towards}"].write(linear_xyw_bytes(there.mvp[index]))
        shape.use(uniforms[""], FREE_UNIT)

    def fog(self, uniforms: Uniforms, moment: Moment, size: tuple[int, int]) -> None:
        """Set the uniforms of fog.glsl: the fog, and the transform from a fragment's position to its ray (X, Y) / Z."""
        # NDC x is P00 X/Z + P02; solved for X/Z, with 2 px / width - 1 for NDC.
        fog, P = self.scene.fog, moment.view.projection
        assert fog is not None
        width, height = size
        uniforms["fog"].value = fog.density, fog.radiance
        uniforms["fog_ray"].value = (
            2 / (width * P[0, 0]),
            2 / (height * P[1, 1]),
            -(1 + P[0, 2]) / P[0, 0],
            -(1 + P[1, 2]) / P[1, 1],
        )

    def draw(self, uniforms: Uniforms, item: DrawItem, t_ns: int) -> None:
        side = item.side(t_ns)
        # State changes are expensive: culling is switched only where it differs.
        if side != self._side:
            (self.gl.ctx.enable if side else self.gl.ctx.disable)(moderngl.CULL_FACE)
            # side < 0: the shape is mirrored at this moment, so its visible faces run the other way round.
            self.gl.ctx.cull_face = "front" if side < 0 else "back"
            self._side = side
        self.resources.vertex_array(uniforms[""], item).render(moderngl.TRIANGLES)
        self.stats.triangles += len(item.mesh.faces)

    def cover(self, source: str, defines: Mapping[str, object]) -> tuple[Uniforms, moderngl.VertexArray]:
        """Return the program over the whole target, and the empty vertex array that draws its one triangle."""
        return self._covers.of((source, *defines.items()), lambda: self._covering(self.gl.program(source, defines)))

    def _covering(self, program: moderngl.Program) -> tuple[Uniforms, moderngl.VertexArray]:
        return self.uniforms(program), self.gl.ctx.vertex_array(program, [])

    def fill(self, array: moderngl.VertexArray, target: Target) -> None:
        """Draw one triangle over all of ``target``."""
        target.use()
        self.gl.ctx.disable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        array.render(moderngl.TRIANGLES, vertices=3)

    def finish(self) -> None:
        """Wait until everything is drawn."""
        started = working_clock()
        self.gl.ctx.finish()
        self.stats.render_s += working_clock() - started

    def forget(self) -> None:
        """Drop all programs, before the context's programs are replaced."""
        for _, array in self._covers.values():
            array.release()
        self.programs.clear()
        self._covers.clear()
        self.line_drawer.release()
        self.resources.forget_vertex_arrays()
