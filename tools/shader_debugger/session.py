"""The subject of the debugger: one sequence's scene as a generation run would build it, a time in it, and an OpenGL
renderer of it whose shaders may be edited while it runs."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from blinkgl.config.run import load_run
from blinkgl.config.sequence import NS_PER_S, SequenceConfig
from blinkgl.errors import ConfigError, GLError
from blinkgl.gl import GLContext, ShaderLoader, create_context
from blinkgl.gl.shader import Uniforms, shader_folder
from blinkgl.render.frames import DEPTH_BUFFER
from blinkgl.render.painter import Painter
from blinkgl.render.passes import Colour, Luminance, Output, ScenePass
from blinkgl.render.passes.shadow import ShadowMap
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import check_assets, sequence_scene
from blinkgl.scene.types import Scene
from blinkgl.tools.shader_debugger.filters import filtered_names, pass_of, places_of

if TYPE_CHECKING:
    import moderngl

    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.painter import RenderStats
    from blinkgl.render.passes.base import Shot
    from blinkgl.render.resources import SceneResources

DEBUG_PROGRAM = "debug.glsl"


@dataclass(frozen=True, eq=False)
class Subject:
    """One sequence. path : its YAML file.   index : its number."""

    path: str
    config: SequenceConfig
    index: int
    scene: Scene


@dataclass(frozen=True)
class When:
    """Times in ns: the moment, and the end times of its flows."""

    t_ns: int
    forward_ns: int
    backward_ns: int

    @property
    def interval_s(self) -> float:
        return (self.forward_ns - self.t_ns) * 1e-9


def open_subject(
    config: str, *, seed: int | None = None, sequence: int | None = None, overrides: list[str] | tuple = ()
) -> Subject:
    """Return the sequence that ``blinkgl generate CONFIG --seed SEED`` would make with number
    ``sequence`` (default: its first), of a recipe with groups in its first group.

    Raises ConfigError and AssetError."""
    template = load_run(config, overrides, seed=seed)
    # Only a group has numbered sequences; the first group represents the recipe.
    if "groups" in template.tree:
        template = template.groups[0].template
    index = template.sequence(0).output.first_index if sequence is None else sequence
    one = template.sequence(index)
    # Before the scene is built, so that a missing file is reported at once.
    check_assets(one.scene, template.base, one.output.split)
    return Subject(str(config), one, index, sequence_scene(one, index, template.base))


def moment(subject: Subject, seconds: float | None = None) -> When:
    """Return the times of the moment ``seconds`` on the sequence's clock (default: the first label).

    Flows lead one label interval forward and backward; beyond the sequence's ends the poses are constant, as
    everywhere. Raises ConfigError for a time outside the sequence."""
    timing, scene = subject.config.time, subject.scene
    if seconds is None:
        t_ns = timing.label_times_ns[0]
    else:
        t_ns = round(seconds * NS_PER_S) if math.isfinite(seconds * NS_PER_S) else None
        if t_ns is None or not scene.t0_ns <= t_ns <= scene.t1_ns:
            raise ConfigError(
                "outside the sequence",
                where="--time",
                value=seconds,
                accepted=f"{scene.t0_ns / NS_PER_S:g} to {scene.t1_ns / NS_PER_S:g} s",
            )
    return When(t_ns, t_ns + timing.interval_ns, t_ns - timing.interval_ns)


def check_pixel(scene: Scene, text: str) -> tuple[int, int]:
    """ "X,Y" as two integers inside the image. Raises ConfigError."""
    width, height = scene.camera.width, scene.camera.height
    accepted = f"X,Y with 0 <= X < {width} and 0 <= Y < {height}"
    try:
        x, y = (int(v) for v in text.split(","))
    except ValueError:
        raise ConfigError("not a pixel", where="--pixel", value=text, accepted=accepted) from None
    if not (0 <= x < width and 0 <= y < height):
        raise ConfigError("outside the image", where="--pixel", value=text, accepted=accepted)
    return x, y


def open_folder(shaders: str | None) -> Path:
    """Return the folder whose shaders are debugged: ``shaders``, or the included ones. Raises
    GLError when it cannot be read, or is older than the debugger."""
    if shaders is None:
        return Path(str(shader_folder()))
    folder = Path(shaders)
    accepted = "a copy of the shaders/ folder"
    if not folder.is_dir():
        raise GLError(
            "no such shader folder" if not folder.exists() else "is not a folder",
            where="--shaders",
            value=shaders,
            accepted=accepted,
        )
    if not os.access(folder, os.R_OK | os.X_OK):
        raise GLError(
            "shader folder cannot be read", where="--shaders", value=shaders, accepted="a folder with read permission"
        )
    if not any(folder.glob("*.glsl")):
        raise GLError("no shaders in this folder", where="--shaders", value=shaders, accepted=accepted)
    if not (folder / DEBUG_PROGRAM).is_file():
        raise GLError(
            f"has no {DEBUG_PROGRAM}", where="--shaders", value=shaders, accepted=f"{accepted} of this version"
        )
    return folder


def files_of(folder: Path) -> list[Path]:
    """Return every shader file below ``folder``, for watching and for messages."""
    return sorted([*folder.glob("*.glsl"), *(folder / "include").rglob("*.glsl")])


class _Nothing:
    """A uniform that the compiler removed: it accepts any value."""

    value = None

    def write(self, data: bytes) -> None:
        pass


class _Uniforms(Uniforms):
    """Records uniforms that the program no longer uses, where a run would stop: the wrong result explains more."""

    def __init__(self, program: moderngl.Program, unused: set[tuple[str, str]]):
        super().__init__(program)
        self._unused = unused

    def __missing__(self, name: str) -> _Nothing:
        self._unused.add((self[""].extra, name))
        return _Nothing()


class DebugPainter(Painter):
    """Draws with edited shaders that no longer use a uniform or an attribute of a shape, and records which.

    unused : (program, name) of each."""

    def __init__(self, gl: GLContext, scene: Scene, resources: SceneResources, stats: RenderStats):
        super().__init__(gl, scene, resources, stats)
        self.unused: set[tuple[str, str]] = set()

    def uniforms(self, program: moderngl.Program) -> Uniforms:
        return _Uniforms(program, self.unused)

    def draw(self, uniforms: Uniforms, item: DrawItem, t_ns: int) -> None:
        # Vertex arrays silently leave out attributes that a program does not have.
        program, shape = uniforms[""], item.deformer
        if shape is not None:
            self.unused |= {(program.extra, name) for name in shape.attributes if name not in program}
        super().draw(uniforms, item, t_ns)

    def forget(self) -> None:
        super().forget()
        self.unused.clear()


@dataclass(frozen=True)
class Inspection(ScenePass):
    """The primitive that wrote a pixel, and the position on it; 0 where no surface is visible. [..., 3] of LOCAL:
    number of the part + 1, an index into ``casting.scene_parts``."""

    program: ClassVar[str] = DEBUG_PROGRAM
    outputs: ClassVar[tuple[Output, ...]] = (  # type: ignore[bad-override]
        Output("TRIANGLE", "R32UI"),
        Output("LOCAL", "RGBA32F"),
        Output("WINDOW", "RGBA32F"),
    )

    def defines(self, kind: object) -> dict[str, Any]:
        return {f"OUT_{output.name}": i for i, output in enumerate(self.outputs)}

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        uniforms["part_number"].value = item.part + 1


SHOWN = tuple(Output(name, "RGBA32F") for name in ("lookup", "albedo", "mirrored", "emission", "terms", "light"))
"""Outputs of the variant SHOW_LOOKUP beside a pass's own."""


@dataclass(frozen=True)
class LuminanceLookup(Luminance):
    """The luminance pass with its lookups as outputs."""

    still: ClassVar[bool] = False

    @property
    def outputs(self) -> tuple[Output, ...]:  # type: ignore[bad-override]
        return (*super().outputs, *SHOWN)

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        return super().defines(kind) | {"SHOW_LOOKUP": 1}

    @classmethod
    def every_kind(cls) -> Iterator[LuminanceLookup]:
        yield cls()


@dataclass(frozen=True)
class ColourLookup(Colour):
    """The colour pass with its lookups as outputs."""

    outputs: ClassVar[tuple[Output, ...]] = (*Colour.outputs, *SHOWN)

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        return super().defines(kind) | {"SHOW_LOOKUP": 1}


@dataclass(frozen=True)
class WholeShadowMap(ShadowMap):
    """A shadow map that is drawn completely, static bodies included."""

    def stands_still(self, whole: bool) -> bool:
        return False


LOOKUPS = {"luminance": LuminanceLookup(), "colour": ColourLookup()}
"""Passes with lookups as outputs. One sample at the pixel's centre, whatever the anti-aliasing."""


class DebugRenderer(Renderer):
    """The production renderer with additional passes. It always draws whole frames, because data kept from an earlier
    frame may come from other shaders.

    filtered : pictures made from other pictures that are shown and compared, see :mod:`filters`.
    as_configured : whether pictures are those of a generation run."""

    filtered: tuple[str, ...] = ()
    as_configured = False

    def __init__(self, gl: GLContext, scene: Scene, config: Any):
        super().__init__(gl, scene, config, whole=True, painter=DebugPainter)

    @property
    def unused(self) -> set[tuple[str, str]]:
        """(program, name) of what was set so far and is not used by the edited shaders."""
        assert isinstance(self._painter, DebugPainter)
        return self._painter.unused

    def use_shaders(self, loader: ShaderLoader) -> None:
        """Draw with another loader's programs from now on."""
        self.forget()
        self.gl.shaders = loader

    def at_pixels(self, flat: np.ndarray) -> np.ndarray:
        """Return the (H, W[, C]) pixels of the camera: the picture itself, or, for a lens, the pixels of the flat
        picture that the lens reads."""
        places = places_of(self.scene.camera)
        # Indexed by whole arrays of rows and columns: a copy of the lens's size.
        return flat if places is None else flat[places[..., 1], places[..., 0]]

    def picture(self, what: str, t_ns: int) -> np.ndarray:
        """Return (H, W) "luminance" or (H, W, 3) "colour", float32: one sample at the pixel's centre, or
        ``as_configured``."""
        if self.as_configured:
            return (self.colour if what == "colour" else self.luminance)(t_ns).read()
        return self.at_pixels(self.draw(pass_of(self, what), t_ns).read())

    def inspect(self, t_ns: int) -> dict[str, np.ndarray]:
        """Return the outputs of debug.glsl, see :class:`Inspection`."""
        frame = self.draw(Inspection(), t_ns)
        return {name: self.at_pixels(frame.read(name)) for name in frame.names}

    def lookups(self, name: str, t_ns: int) -> dict[str, np.ndarray]:
        """Return the lookups and factors of the pass "luminance" or "colour", float32, from its own source (variant
        SHOW_LOOKUP): result (H, W[, 3]) as the pass writes it; uv (H, W, 2); level, count (H, W), the number of
        lookups; light, and its terms direct, shadow, around (H, W); albedo, mirrored, emission, light_rgb (H, W, 3).
        One sample at the pixel's centre whatever the anti-aliasing; 0 where no surface is visible."""
        frame = self.draw(replace(LOOKUPS[name], shadows=self._shadows), t_ns)
        read = {output: self.at_pixels(frame.read(output)) for output in frame.names}
        lookup, albedo, terms = read["lookup"], read["albedo"], read["terms"]
        return {
            "result": read[name],
            "uv": lookup[..., :2],
            "level": lookup[..., 2],
            "light": lookup[..., 3],
            "albedo": albedo[..., :3],
            "count": albedo[..., 3],
            "direct": terms[..., 0],
            "shadow": terms[..., 1],
            "around": terms[..., 2],
            "mirrored": read["mirrored"][..., :3],
            "emission": read["emission"][..., :3],
            "light_rgb": read["light"][..., :3],
        }

    @property
    def maps(self) -> tuple[ShadowMap, ...]:
        """Maps of the lamps that cast shadows, in the shaders' order."""
        return self._shadows

    def shadow_map(self, k: int, t_ns: int) -> np.ndarray:
        """Return (texels, texels) float32, the depths of map k with all bodies that cast shadows, 0 where there is
        none."""
        frame = self.draw(WholeShadowMap(**vars(self.maps[k])), t_ns)
        depths = np.empty((self.maps[k].texels,) * 2, np.float32)
        frame.texture(DEPTH_BUFFER).read_into(depths)
        return depths

    def raw(
        self, t_ns: int, *names: str, forward_ns: int | None = None, backward_ns: int | None = None
    ) -> dict[str, np.ndarray]:
        """Return buffers of label.glsl as the shader wrote them, without the masks of ground truth, by
        the names of their labels: depth, ids …"""
        ends = {way: t for way, t in (("forward", forward_ns), ("backward", backward_ns)) if t is not None}
        frame = self.draw(self.geometry(names), t_ns, ends)
        return {name: frame.read(name) for name in names}


@contextmanager
def open_renderer(subject: Subject, shaders: str | None = None, *, as_configured: bool = False) -> Any:
    """Return a :class:`DebugRenderer` of the subject with the shaders of a folder, on the configuration's OpenGL.

    as_configured : anti-aliasing as in generation; otherwise one sample at the pixel centre, as for the reference's
    rays.   Raises GLError."""
    folder = open_folder(shaders)
    with create_context(subject.config.gl.backend, subject.config.gl.device) as gl:
        gl.shaders = ShaderLoader(gl.ctx, folder)
        config = subject.config.render
        if not as_configured:
            config = config.model_copy(update={"antialiasing": "none", "image_antialiasing": "none"})
        with DebugRenderer(gl, subject.scene, config) as renderer:
            renderer.filtered, renderer.as_configured = filtered_names(subject.config, subject.scene), as_configured
            yield renderer
