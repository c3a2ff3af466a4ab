"""Base classes of passes. See docs/extending.md, "A pass"."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from blinkgl.gl.shader import Uniforms
from blinkgl.render.antialiasing import Samples
from blinkgl.render.frames import Frame, Output, Rectangle

if TYPE_CHECKING:
    from blinkgl.gl import Target
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.moment import Moment
    from blinkgl.render.painter import Painter
    from blinkgl.scene.types import Scene


class Input(NamedTuple):
    """Another pass's output that a pass reads, at the same moment. sampler : its uniform.
    output : name of an output of ``of`` (default: its first), or ``DEPTH_BUFFER``, where ``of`` keeps that as a
    texture."""

    sampler: str
    of: Pass
    output: str = ""


@dataclass(frozen=True, eq=False)
class Shot:
    """The arguments of one drawing of a pass. ends : moments at other times, by name ("forward", "backward").
    inputs : frames of the passes it reads, by sampler."""

    moment: Moment
    target: Target
    scene: Scene
    ends: Mapping[str, Moment] = field(default_factory=dict)
    inputs: Mapping[str, Frame] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """Return (width, height) of the target, px."""
        return self.target.width, self.target.height


class Pass:
    """One kind of picture of a scene: what is drawn, by which program, into what. A pass is a value (a frozen
    dataclass) without resources; equal passes share their programs, target and memory, which belong to the renderer:
    ``renderer.draw(pass, t_ns)`` returns a Frame.

    program : file in shaders/, or the absolute path of one of your own (its includes are those of shaders/).
    outputs : what it writes.   inputs : what it reads, drawn first.   samples, every : its size relative to the
    image's.
    depth : whether it has a depth buffer; "texture": one that a later pass may read; "texture of 16 bits": the same, of
    16-bit integers.
    still : whether only moving objects are redrawn for a camera that stands still.
    lit : whether its program uses light.glsl for the light, and fog.glsl for the fog.
    one_channel : whether one channel suffices for surfaces of one colour.
    common : it depends on the time and the scene more than on the viewer, so that the picture for one sensor of a rig
    is used for the others where it :meth:`serves`.
    pointwise : each pixel depends only on the inputs' pixel at the same place (or where :meth:`changed` says), so it
    changes only where they do."""

    program: ClassVar[str]
    outputs: tuple[Output, ...]
    inputs: tuple[Input, ...] = ()
    samples: Samples = Samples()
    every: int = 1
    depth: ClassVar[bool | str] = True
    still: ClassVar[bool] = False
    lit: ClassVar[bool] = False
    one_channel: ClassVar[bool] = False
    common: ClassVar[bool] = False
    pointwise: ClassVar[bool] = False

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return the size of its target, px, for an image of width x height: ``samples.grid`` times as fine, or every
        n-th pixel, at least one."""
        return max(1, width * self.samples.grid // self.every), max(1, height * self.samples.grid // self.every)

    def background(self, scene: Scene) -> tuple[float, ...]:
        """Return the first output's value where nothing is hit; missing components and all other outputs are 0."""
        return ()

    def defines(self, kind: Kind | None) -> dict[str, object]:
        """Return the defines of the program variant, for a kind of material (None: no material at all); TEXTURED, LIT
        and TWO_SIDED are added, and, for a ``lit`` pass, those of the scene's light."""
        return {}

    def stands_still(self, whole: bool) -> bool:
        """Return whether only moving objects are redrawn. whole : no pass of the camera's is to be drawn so."""
        return self.still and not whole

    def changed(self, painter: Painter, rectangles: list[Rectangle]) -> list[Rectangle]:
        """Return where a ``pointwise`` pass changes when its inputs change in these rectangles."""
        return rectangles

    def seen(self, moment: Moment) -> Moment:
        """Return the moment as this pass sees it: the camera's, unless it draws for another one
        (``moment.from_place``)."""
        return moment

    def serves(self, drawn: Moment, moment: Moment) -> bool:
        """Return whether the picture that a ``common`` pass drew of the moment ``drawn`` is also right for
        ``moment``, so that it need not be drawn again."""
        return drawn.t_ns == moment.t_ns

    def begin(self, painter: Painter, shot: Shot) -> None:
        """Prepare :meth:`paint`: clear what it does not write everywhere."""

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        """Draw into ``shot.target``. items : only these, for a pass that draws the scene."""
        raise NotImplementedError

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        """Yield a pass of every program variant that can be requested; `blinkgl shader check` compiles them."""
        yield cls()

    def bind(self, uniforms: Uniforms, shot: Shot) -> None:
        """Bind the inputs to a program. Unit 0 is the material's."""
        for unit, one in enumerate(self.inputs, 1):
            shot.inputs[one.sampler].texture(one.output).use(unit)
            uniforms[one.sampler].value = unit


class OverPass(Pass):
    """A pass over the picture of another one, with its outputs, on every n-th pixel where that is."""

    of: Pass

    @property
    def outputs(self) -> tuple[Output, ...]:  # type: ignore[bad-override]
        return self.of.outputs

    @property
    def every(self) -> int:  # type: ignore[bad-override]
        return self.of.every


class Programs(dict["Kind", Uniforms]):
    """The programs of one pass: uniforms per kind of material, compiled when first needed."""

    def __init__(self, painter: Painter, pass_: ScenePass):
        self._painter, self._pass = painter, pass_

    def __missing__(self, kind: Kind) -> Uniforms:
        # Defines of the pass, of the material, of the light and of the fog make the variant.
        pass_, lighting = self._pass, self._painter.lighting
        light = lighting.defines(kind, pass_.one_channel, getattr(pass_, "shadows", ())) if pass_.lit else {}
        foggy = {"FOG": 1} if pass_.lit and self._painter.scene.fog is not None else {}
        # One program for each kind of item; unused features are not even compiled.
        defines = pass_.defines(kind) | kind.defines(pass_.lit) | light | foggy
        program = self._painter.gl.program(pass_.program, defines)
        uniforms = self[kind] = self._painter.uniforms(program)
        return uniforms


class ScenePass(Pass):
    """A pass that draws the scene's items."""

    def items(self, moment: Moment) -> list[DrawItem]:
        """Return what is drawn, in this order."""
        return moment.visible

    def begin(self, painter: Painter, shot: Shot) -> None:
        painter.begin(shot.target, self.background(shot.scene))

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        """Set textures and uniforms of the program besides those that every program of the scene has."""

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        programs, ready = self.programs(painter), set()
        for item in self.items(shot.moment) if items is None else items:
            uniforms = programs[item.kind]
            if item.kind not in ready:
                ready.add(item.kind)
                self.prepare(painter, shot, uniforms)
            self.draw_item(painter, shot, item, uniforms)

    def prepare(self, painter: Painter, shot: Shot, uniforms: Uniforms) -> None:
        """Set all that a program needs of the picture, once before its items."""
        painter.ready(uniforms, shot.moment, shot.size)
        self.bind(uniforms, shot)

    def programs(self, painter: Painter) -> dict[Kind, Uniforms]:
        """Return the painter's programs for this pass, by kind of material."""
        return painter.programs.of(self, lambda: Programs(painter, self))

    def draw_item(self, painter: Painter, shot: Shot, item: DrawItem, uniforms: Uniforms) -> None:
        """Draw one item with the program that ``uniforms`` belong to."""
        self.dress_item(painter, shot, item, uniforms)
        painter.draw(uniforms, item, shot.moment.t_ns)

    def dress_item(self, painter: Painter, shot: Shot, item: DrawItem, uniforms: Uniforms) -> None:
        """Set all that a program needs of an item."""
        painter.place(uniforms, item, shot.moment)
        if item.deformer is not None:
            painter.deform(uniforms, item, shot.moment, shot.ends)
        self.set(painter, uniforms, item, shot)


class ScreenPass(Pass):
    """A pass over all pixels of its target, from its inputs: one triangle, whose vertex stage has no attributes."""

    depth: ClassVar[bool | str] = False

    def set(self, uniforms: Uniforms, shot: Shot) -> None:
        """Set uniforms of the program besides its inputs."""

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        uniforms, array = painter.cover(self.program, self.defines(None))
        self.bind(uniforms, shot)
        self.set(uniforms, shot)
        painter.fill(array, shot.target)
