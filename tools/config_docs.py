"""Writes the pages of every YAML key with its type, default, limits and meaning, from the models themselves.

    python -m blinkgl.tools.config_docs > docs/configuration.md
    python -m blinkgl.tools.config_docs eflow > docs/eflow_configuration.md

A test fails when a page and its models differ.
"""

from __future__ import annotations

import re
import sys
import types
import typing

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from blinkgl.config.base import is_model, members, tag_of
from blinkgl.config.primitives import PRIMITIVES
from blinkgl.config.rig import SECTIONS, RigSensorConfig
from blinkgl.config.sequence import SequenceConfig
from blinkgl.scene.geometry import BUILDERS
from blinkgl.scene.geometry.primitives import PARAMETERS, parameters
from eflow.config import TrainConfig

HEADER = """# Every key of the YAML

Made from the configuration models by `python -m blinkgl.tools.config_docs`; do not edit.

A key that is left out has its default, a table without `kind` (or `emulator`) is of the default kind. `null` as a
default means none, where the row does not explain it. A range of two numbers may be a single number.

In place of a value, a distribution may stand, which is drawn once per sequence: `{uniform: [a, b]}`,
`{log_uniform: [a, b]}`, `{normal: [mean, deviation, lowest, highest]}`, `{integer: [a, b]}` (both ends included),
`{choice: [x, y, …]}`, `{weighted: {x: 3, y: 1}}`, `{shares: [{share: 0.8, value: x}, …]}` (of ten consecutive
sequences about eight). `seed`, `output` and `gl` cannot be drawn.

`groups: {name: {…}}` at the top level makes groups of sequences. Each has the keys of the top level with its own over
them; `enabled: false` leaves one out (`configs/blinkflow.yaml`).
"""


EFLOW_HEADER = """# Every key of eflow's YAML

Made from the configuration models by `python -m blinkgl.tools.config_docs eflow`; do not edit.

`eflow train CONFIG` reads these keys; `--set a.b=c` overrides them. A key that is left out has its default; `null` as
a default means none, where the row does not explain it. Paths start from the YAML file's folder. Examples:
`configs/eflow/`.
"""


def page() -> str:
    """The whole page of ``blinkgl generate``'s YAML as Markdown."""
    return HEADER + "".join(_Page().section(SequenceConfig, "")) + _primitives()


def _primitives() -> str:
    """What `scene.meshes.<name>.parameters` may hold, from the builders' own signatures."""
    lines = [
        "\n## Primitives\n\n",
        (
            "`scene.meshes.<name>`, for example `{primitive: cylinder, parameters: {radius: 0.2, height: 2}}`. Their "
            "axis is z, their centre the origin; sizes are in world units (m), before the object's `scale`.\n\n"
        ),
        "|kind|parameters and defaults|what it is|\n|---|---|---|\n",
    ]
    for kind in PRIMITIVES:
        build = BUILDERS[kind]
        values = ", ".join(
            f"`{name}: {list(value) if isinstance(value, tuple) else value}`"
            for name, value in parameters(kind).items()
        )
        lines.append(f"|`{kind}`|{values}|{' '.join((build.__doc__ or '').split()).replace('``', '`')}|\n")
    lines.append("\n|parameter|meaning|\n|---|---|\n")
    lines += [f"|`{name}`|{meaning}|\n" for name, meaning in PARAMETERS.items()]
    return "".join(lines)


def eflow_page() -> str:
    """The whole page of ``eflow train``'s YAML as Markdown."""
    return EFLOW_HEADER + "".join(_Page().section(TrainConfig, ""))


class _Page:
    """Makes the sections. A model is described where it first stands, and so is a key that another section has, too:
    later places name the section."""

    def __init__(self) -> None:
        self.described: dict[type[BaseModel], str] = {}
        self.said: dict[str, str] = {}

    def section(self, model: type[BaseModel], path: str, note: str = "") -> list[str]:
        """Return the lines of a model's section, and of those below it that are new."""
        title = f"`{path}`{note}" if path else "Top level"
        self.described[model] = title
        rows: dict[str, str] = {}
        below: list[tuple[type[BaseModel], str, str]] = []
        for name, info in model.model_fields.items():
            if (tag := tag_of(model)) and name == tag[0] and note:
                continue  # the heading says it
            inner = f"{path}.{name}" if path else name
            # a sensor's sections are those of a single camera, and have been described
            children = [] if model is RigSensorConfig and name in SECTIONS else _models(info.annotation)
            known = [self.described[child] for child in children if child in self.described]
            rows[name] = self._row(name, info, known[0] if known and len(children) == 1 else None)
            origin = typing.get_origin(info.annotation)
            place = inner + (".<name>" if origin is dict else "[]" if origin in (tuple, list) else "")
            for child in children:
                tag = tag_of(child) if len(children) > 1 else None
                below.append((child, place, f" with `{tag[0]}: {tag[1]}`" if tag else ""))
        about = " ".join((model.__doc__ or "").split()).replace("``", "`")
        lines = [f"\n## {title}\n\n{about}\n", *self._shown(title, rows)]
        for child, place, suffix in below:
            if child not in self.described:
                lines += self.section(child, place, suffix)
        return lines

    @staticmethod
    def _row(name: str, info: FieldInfo, known: str | None) -> str:
        meaning = (info.description or _about(info)).replace("``", "`").replace("|", "\\|")
        default = _default(info)
        if known is not None:
            meaning += f"; keys: {known}"
            default = default.replace("below", "")
        return f"|`{name}`|{_type(info)}|{default}|{meaning}|\n"

    def _shown(self, title: str, rows: dict[str, str]) -> list[str]:
        """Return the table of the rows that no other section has; a sentence names the others."""
        elsewhere: dict[str, list[str]] = {}
        for name, row in rows.items():
            if row in self.said:
                elsewhere.setdefault(self.said[row], []).append(name)
        # One key alone is quicker read than looked up.
        elsewhere = {place: names for place, names in elsewhere.items() if len(names) > 1}
        left_out = {name for names in elsewhere.values() for name in names}
        for row in rows.values():
            self.said.setdefault(row, title)
        sentences = [f"As in {place}: {', '.join(f'`{n}`' for n in names)}." for place, names in elsewhere.items()]
        shown = [row for name, row in rows.items() if name not in left_out]
        head = ["\n|key|type|default|meaning|\n|---|---|---|---|\n"] if shown else []
        return ["\n" + " ".join(sentences) + "\n"] * bool(sentences) + head + shown


def _about(info: FieldInfo) -> str:
    """Return what a table is, for a key without a description: how its section begins."""
    return "; ".join(
        re.split(r"[,:.] |\.$", " ".join((m.__doc__ or "").split()))[0] for m in _models(info.annotation)[:1]
    )


def _models(annotation: object) -> list[type[BaseModel]]:
    if is_model(annotation):
        return members(annotation)
    return [m for a in typing.get_args(annotation) for m in _models(a)]


def _type(info: FieldInfo) -> str:
    """ "number 0…1", "integer ≥ 1", "text". A null that is the default is not said again."""
    low = high = ""
    for m in info.metadata:
        for attribute, sign in (("gt", "> "), ("ge", "≥ "), ("lt", "< "), ("le", "≤ ")):
            if isinstance(m, getattr(annotated_types, attribute.capitalize())):
                limit = f"{getattr(m, attribute):g}".replace("e+0", "e").replace("e+", "e")
                low, high = (low, sign + limit) if attribute in ("lt", "le") else (sign + limit, high)
    limits = f"{low[2:]}…{high[2:]}" if low[:1] == "≥" and high[:1] == "≤" else ", ".join(filter(None, (low, high)))
    return " ".join(filter(None, (_name(info.annotation, null=info.default is not None), limits)))


def _name(annotation: object, null: bool = True) -> str:
    """Return a type in words: "number", "3 numbers", "`a`, `b` or list of text". ``null``: whether to name it."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return _name(arguments[0])
    if origin is typing.Literal:
        return ", ".join(f"`{str(a).lower() if isinstance(a, bool) else a}`" for a in arguments)
    if origin in (typing.Union, types.UnionType):
        names = dict.fromkeys(_name(a) for a in arguments if null or a is not type(None))
        return " or ".join(names)
    if origin is tuple and arguments and arguments[-1] is not Ellipsis:
        (element,) = {_name(a) for a in arguments}
        rows = element.partition(" ")[0].isdigit()
        return f"{len(arguments)} {'rows of ' + element if rows else element + 's'}"
    if origin in (tuple, list):
        return f"list of {_name(arguments[0])}"
    if origin is dict:
        return f"table of {_name(arguments[1])}"
    if annotation is type(None):
        return "null"
    if annotation is typing.Any:
        return "any value"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table"
    return {"float": "number", "int": "integer", "str": "text", "bool": "true/false"}.get(
        getattr(annotation, "__name__", ""), str(annotation)
    )


def _default(info: FieldInfo) -> str:
    if info.is_required():
        return "required"
    value = info.get_default(call_default_factory=True)
    if isinstance(value, BaseModel):
        tag = tag_of(type(value))
        return f"`{tag[0]}: {tag[1]}`" if tag and len(_models(info.annotation)) > 1 else "below"
    if isinstance(value, tuple):
        return "`[" + ", ".join(str(v) for v in value) + "]`"
    return "`null`" if value is None else f"`{str(value).lower() if isinstance(value, bool) else value}`"


if __name__ == "__main__":
    print(eflow_page() if sys.argv[1:] == ["eflow"] else page(), end="")
