"""What a pass is. See docs/extending.md, "A pass"."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from blinkgl.render.antialiasing import Samples

if TYPE_CHECKING:
    from blinkgl.gl import Target
    from blinkgl.render.canvas import Frame, Rectangle
    from blinkgl.render.draw_items import DrawItem, Kind
    from blinkgl.render.moment import Moment
    from blinkgl.render.painter import Painter, Uniforms
    from blinkgl.scene.types import Scene


class Output(NamedTuple):
    """An attachment: ``layout(location = i)`` of the fragment stage for the i-th output of a pass.

    format : key of :data:`blinkgl.gl.FORMATS`.
    components : how many of its format's are given out, the first ones; 0: all."""

    name: str
    format: str
    components: int = 0


class Input(NamedTuple):
    """What a pass reads of another one, at the same moment. sampler : the uniform that gets it.
    output : name of an output of ``of`` (default: its first), or ``DEPTH_BUFFER``, where
    ``of`` keeps that as a texture."""

    sampler: str
    of: Pass
    output: str = ""


@dataclass(frozen=True, eq=False)
class Shot:
    """What one drawing of a pass is given. ends : moments at other times, by name ("forward", "backward").
    inputs : frames of the passes it reads, by sampler."""

    moment: Moment
    target: Target
    scene: Scene
    ends: Mapping[str, Moment] = field(default_factory=dict)
    inputs: Mapping[str, Frame] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """Of the target, (width, height) px."""
        return self.target.width, self.target.height


class Pass:
    """One kind of picture of a scene: what is drawn, by which program, into what. A pass is a value (a frozen
    dataclass) and holds nothing; equal passes share their programs, target and memory, which belong to the renderer:
    ``renderer.draw(pass, t_ns)`` gives a Frame.

    program : file in shaders/, or the absolute path of one of your own (its includes are those of shaders/).
    outputs : what it writes.   inputs : what it reads, drawn before it.   samples, every : its size beside the image's.
    depth : whether it has a depth buffer; "texture": one that a later pass may read; "texture of 16 bits": the same,
    not of floats.
    still : whether a camera that stands still has only what moves drawn again.
    lit : whether its program asks light.glsl for the light, and fog.glsl for what of it arrives.
    one_channel : whether one channel of it will do, where the surface is of one colour.
    common : it hangs on the time and the scene more than on who looks, so that what was drawn for one sensor of a rig
    is used for the others where it :meth:`serves`.
    pointwise : each pixel comes of the inputs' pixel at the same place (or where :meth:`changed` says), so that it does
    not change where they do not."""

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
        """Of its target, px, for an image of width x height: ``samples.grid`` times as fine,
        or every n-th pixel, at least one."""
        return max(1, width * self.samples.grid // self.every), max(1, height * self.samples.grid // self.every)

    def background(self, scene: Scene) -> tuple[float, ...]:
        """The first output where nothing is hit; 0 where it ends, and in all others."""
        return ()

    def defines(self, kind: Kind | None) -> dict[str, Any]:
        """Of the program variant, for a kind of material (None: no material at all);
        TEXTURED, LIT and TWO_SIDED come on top,
        and, of a pass that is ``lit``, those of the scene's light."""
        return {}

    def stands_still(self, whole: bool) -> bool:
        """Whether only what moves is drawn again. whole : no pass of the camera's is to be drawn so."""
        return self.still and not whole

    def changed(self, painter: Painter, rectangles: list[Rectangle]) -> list[Rectangle]:
        """Where a pass that is ``pointwise`` changes when its inputs change in these rectangles."""
        return rectangles

    def seen(self, moment: Moment) -> Moment:
        """The moment as this pass looks at it: the camera's, unless it draws for another one
        (``moment.from_place``)."""
        return moment

    def serves(self, drawn: Moment, moment: Moment) -> bool:
        """Of a pass that is ``common``: whether what it last drew, as it saw it then, will do for a moment."""
        return drawn.t_ns == moment.t_ns

    def begin(self, painter: Painter, shot: Shot) -> None:
        """Before :meth:`paint`: clears what it does not write everywhere."""

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        """Draws into ``shot.target``. items : these alone, of a pass that draws the scene."""
        raise NotImplementedError

    @classmethod
    def every_kind(cls) -> Iterator[Pass]:
        """A pass of every program variant that somebody may ask for: what `blinkgl shader check` compiles."""
        yield cls()

    def bind(self, uniforms: Uniforms, shot: Shot) -> None:
        """Hands the inputs to a program. Unit 0 is the material's."""
        for unit, one in enumerate(self.inputs, 1):
            shot.inputs[one.sampler].texture(one.output).use(unit)
            uniforms[one.sampler].value = unit


class ScenePass(Pass):
    """A pass that draws the scene's items."""

    def items(self, moment: Moment) -> list[DrawItem]:
        """What is drawn, in this order."""
        return moment.visible

    def begin(self, painter: Painter, shot: Shot) -> None:
        painter.begin(shot.target, self.background(shot.scene))

    def set(self, painter: Painter, uniforms: Uniforms, item: DrawItem, shot: Shot) -> None:
        """Textures and uniforms of the program besides those that every program of the scene has."""

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        programs = painter.programs(self)
        for item in self.items(shot.moment) if items is None else items:
            self.draw_item(painter, shot, item, programs[item.kind])

    def draw_item(self, painter: Painter, shot: Shot, item: DrawItem, uniforms: Uniforms) -> None:
        """One of them, by the program that ``uniforms`` belong to."""
        self.dress_item(painter, shot, item, uniforms)
        painter.draw(uniforms, item)

    def dress_item(self, painter: Painter, shot: Shot, item: DrawItem, uniforms: Uniforms) -> None:
        """Hands a program all that it takes of an item."""
        painter.place(uniforms, item, shot.moment)
        if item.deformer is not None:
            painter.deform(uniforms, item, shot)
        if "fog" in uniforms:
            painter.fog(uniforms, shot)
        self.bind(uniforms, shot)
        self.set(painter, uniforms, item, shot)


class ScreenPass(Pass):
    """A pass over all pixels of its target, from its inputs: one triangle, whose vertex stage has no attributes."""

    depth: ClassVar[bool | str] = False

    def set(self, uniforms: Uniforms, shot: Shot) -> None:
        """Uniforms of the program besides its inputs."""

    def paint(self, painter: Painter, shot: Shot, items: Iterable[DrawItem] | None = None) -> None:
        uniforms, array = painter.cover(self)
        self.bind(uniforms, shot)
        self.set(uniforms, shot)
        painter.fill(array, shot.target)
