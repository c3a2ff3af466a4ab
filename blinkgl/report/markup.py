"""Pages from templates (jinja2). Whatever is put into one is escaped, unless a template itself
made it; a name that is missing is an error."""

from __future__ import annotations

import base64
from functools import lru_cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from blinkgl.report.charts import number, size

if TYPE_CHECKING:
    import jinja2


def render(name: str, **values: Any) -> str:
    """The HTML text of a template ``"ROOM/FILE.html"``, which is blinkgl/ROOM/templates/FILE.html."""
    return _environment().get_template(name).render(values)


def png(array: np.ndarray) -> str:
    """(H, W, 3) uint8 RGB as a data URI."""
    ok, data = cv2.imencode(".png", np.ascontiguousarray(array[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert ok
    return data_uri(data.tobytes())


def data_uri(file: bytes) -> str:
    """The bytes of a PNG file as a data URI."""
    return "data:image/png;base64," + base64.b64encode(file).decode()


@lru_cache(1)
def _environment() -> jinja2.Environment:
    import jinja2  # a page is the last thing that anybody makes

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_source),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(number=number, size=size)
    return environment


def _source(name: str) -> str:
    room, _, file = name.partition("/")
    return resources.files("blinkgl").joinpath(room, "templates", file).read_text(encoding="utf-8")
