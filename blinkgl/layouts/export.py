"""The table of layouts, and the export of a whole data set, which appears completely or not at all."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from blinkgl.config.run import RunTemplate
from blinkgl.dataset.plan import Plan
from blinkgl.errors import AssetError, ConfigError, OutputError
from blinkgl.io.atomic import atomic_folder
from blinkgl.io.records import path_inside
from blinkgl.layouts.blinkflow import BlinkFlow
from blinkgl.layouts.dsec import Dsec, ERaft
from blinkgl.layouts.intervals import Intervals
from blinkgl.layouts.layout import Layout
from blinkgl.layouts.multiflow import MultiFlow
from blinkgl.layouts.mvsec import Mvsec
from blinkgl.layouts.nerf import Nerf
from blinkgl.layouts.point_tracks import EventKubric, TapVid
from blinkgl.layouts.rosbag import RosBag
from blinkgl.layouts.source import Planned, Source, sources_of
from blinkgl.machine.heartbeat import heartbeat
from blinkgl.sequence_files.index import data_set

# ---------------------------------------------------------------------------------------------------------------------
# The available layouts.

LAYOUTS: dict[str, Layout] = {
    layout.name: layout
    for layout in (
        *(Dsec(), ERaft(), BlinkFlow(), Mvsec(), TapVid(), MultiFlow(), EventKubric(), RosBag()),
        *(Nerf(), Intervals()),
    )
}


def register(layout: Layout) -> Layout:
    """Add a layout to the table that `blinkgl export` reads, and return it. Raises TypeError: its name is taken."""
    if layout.name in LAYOUTS:
        raise TypeError(f"layout '{layout.name}': there is one already")
    LAYOUTS[layout.name] = layout
    return layout


def layout_of(name: str) -> Layout:
    """Return the layout of this name. Raises ConfigError: there is none."""
    if name not in LAYOUTS:
        raise ConfigError("no such layout", where="--layout", value=name, accepted=", ".join(["webdataset", *LAYOUTS]))
    return LAYOUTS[name]


@dataclass(frozen=True)
class Exported:
    """The result of an export. sequences : their number.   said : notes for the user, a line each.   opened_by : the
    loaders that open it."""

    sequences: int
    said: tuple[str, ...]
    opened_by: str


def export_layout(root: str | Path, out: str | Path, layout: str) -> Exported:
    """Write the data set (or the one sequence) ``root`` as the folder ``out``, in a layout of the table.

    Raises, before anything is written, ConfigError: no such layout; AssetError: no sequences, a damaged one, or a
    missing part, with the YAML that makes it; OutputError: ``out`` exists or cannot be written, two sequences in one
    place."""
    row, root, out = layout_of(layout), Path(root), Path(out)
    if root.is_file():
        raise AssetError(
            "a file of events keeps no frames and no labels",
            where=str(root),
            accepted="a data set: 'blinkgl generate' with frames: {folders: […]} makes one of recorded frames",
        )
    sources = sources_of(data_set(root))
    if not sources:
        raise AssetError("no sequences found", where=str(root), accepted="a folder that 'blinkgl generate' wrote")
    # Nothing is written before every sequence is known to have what the layout needs.
    for source in sources:
        _refuse_what_lacks(row, source)
    places = _places(row, sources)
    lines = _size(row, sources)
    with atomic_folder(out) as folder:
        for number, (source, place) in enumerate(zip(sources, places), 1):
            heartbeat.at(f"sequence {number:,} of {len(sources):,}")
            (folder / place).mkdir(parents=True, exist_ok=True)
            lines += row.write(source, folder / place)
        # Loaders open folders of splits that may be empty.
        for split in row.splits:
            (folder / split).mkdir(exist_ok=True)
    held = {place.split("/")[0] for place in places}
    lines += [f"nothing in {split}/, which its loaders open" for split in row.filled if split not in held]
    return Exported(len(sources), tuple(lines), row.opened_by(out))


def refuse_plan(template: RunTemplate, num: int | None, layout: str) -> None:
    """Raise AssetError when no sequence of a run can have what a layout of the table takes, before it is generated."""
    row = layout_of(layout)
    for group in Plan.of(template, num).used:
        configs = [one for one in group.template.corners if any(camera.gives_events for camera in one.cameras())]
        planned = [Planned.of(one, Path(group.name or "the recipe")) for one in configs if one.frames is None]
        if len(planned) == len(configs) and all(row.missing(one) for one in planned):
            for one in planned[:1]:
                _refuse_what_lacks(row, one)


def _refuse_what_lacks(row: Layout, source: Source) -> None:
    if missing := row.missing(source):
        raise AssetError(
            f"layout '{row.name}' takes {' and '.join(m.what for m in missing)}, which this sequence does not have",
            where=str(source.folder),
            accepted="a data set made with " + ", ".join(f"'{m.yaml}'" for m in missing),
        )


def _places(row: Layout, sources: list[Source]) -> list[str]:
    places = [f"{row.folder(source)}/{source.name}" for source in sources]
    for place, source in zip(places, sources):
        try:
            path_inside(place)
        except ValueError as error:
            where = str(source.folder)
            raise AssetError(f"names {error}", where=where, value=place, accepted="a plain relative path") from None
    if twice := [place for place in places if places.count(place) > 1]:
        raise OutputError(
            "two sequences would be written to the same place", where=f"layout '{row.name}'", value=twice[0]
        )
    return [row.folder(source) for source in sources]


def _size(row: Layout, sources: list[Source]) -> list[str]:
    if row.size is None:
        return []
    height, width = row.size
    seen = ", ".join(f"{w}x{h}" for w, h in sorted({(s.width, s.height) for s in sources} - {(width, height)}))
    if not seen:
        return []
    return [f"its published loaders expect {width}x{height} px, and this is {seen}: theirs have to be told"]
