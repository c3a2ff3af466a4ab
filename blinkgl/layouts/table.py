"""The layouts there are."""

from __future__ import annotations

from blinkgl.errors import ConfigError
from blinkgl.layouts.blinkflow import BlinkFlow
from blinkgl.layouts.dsec import Dsec, ERaft
from blinkgl.layouts.layout import Layout
from blinkgl.layouts.multiflow import MultiFlow
from blinkgl.layouts.mvsec import Mvsec
from blinkgl.layouts.tapvid import TapVid

LAYOUTS: dict[str, Layout] = {row.name: row for row in (Dsec(), ERaft(), BlinkFlow(), Mvsec(), TapVid(), MultiFlow())}


def layout_of(name: str) -> Layout:
    """Raises ConfigError: there is none of that name."""
    if name not in LAYOUTS:
        raise ConfigError("no such layout", where="--layout", value=name, accepted=", ".join(["webdataset", *LAYOUTS]))
    return LAYOUTS[name]
