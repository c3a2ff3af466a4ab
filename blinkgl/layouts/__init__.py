"""Data sets in the layouts of published data sets: their files, names, shapes, scales and clocks.

In:    sequence directories
Out:   folders that loaders of DSEC, E-RAFT, BlinkFlow, MVSEC, TAP-Vid, MultiFlow, EventKubric and NeRF sets open
Start: export.py, then layout.py: a row of the table is a layout
"""

from blinkgl.layouts.export import LAYOUTS, export_layout, layout_of
from blinkgl.layouts.layout import Layout, Missing
from blinkgl.layouts.source import Source

__all__ = ["LAYOUTS", "Layout", "Missing", "Source", "export_layout", "layout_of"]
