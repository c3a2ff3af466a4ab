"""Sensors: the known properties of a camera, in a form that the emulators can use.

A sensor is a YAML file, shipped or a user's own:

    name: my DAVIS
    width: 346
    height: 260
    contrast_threshold: 0.3                    # of any emulator, unless given more exactly below
    emulators:                                 # keys of `events:` by emulator; they override the above
      esim: {contrast_threshold: 0.29, log_eps: 0.03}
      voltmeter: {preset: DVS346, k1: {log_uniform: [1.8, 4.1]}}
    readout: {events_per_second: 12.0e+6}
    sources:                                   # sources of the values, by their place in the file
      contrast_threshold: data sheet, table 2
      emulators.esim: fitted here to slider_depth, first half
    uncertainty: {emulators.esim.log_eps: 0.004}

A value may be a distribution over units and bias settings (:mod:`blinkgl.config.draw`), because two cameras of one name
differ. A sequence draws one unit; :func:`load_sensor` returns the middle, or a unit by number.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag

from blinkgl.config.base import Config, Refused, placed, rule
from blinkgl.config.draw import corners, draw, is_distribution, middle
from blinkgl.config.events import EmulatorConfig
from blinkgl.config.names import shipped_names
from blinkgl.config.problems import validate
from blinkgl.config.reader import read_table, shipped
from blinkgl.config.readout import ReadoutConfig
from blinkgl.errors import ConfigError
from blinkgl.types.trees import Tree


def _emulator_tables(tables: dict[str, dict[str, object]]) -> dict[str, dict[str, object]]:
    """Check the keys of each emulator by a field validator: a rule would combine the keys of all emulators."""
    models = EmulatorConfig.members
    for name, keys in tables.items():
        if name not in models:
            raise Refused("unknown emulator", value=name, accepted="one of " + ", ".join(models))
        if "emulator" in keys:
            raise Refused("the name of the table is the emulator", where=name, value=keys["emulator"])
        # A problem is reported by its place in the sensor file, not in ``events:``.
        with placed(lambda key, name=name: name if key in ("", "config") else f"{name}.{key}", Refused):
            validate(models[name], keys)
    return tables


class SensorConfig(Config):
    """One unit of a camera. Thresholds are in ln units: a contrast of 15 % is ln 1.15 = 0.14. Null: the emulator's
    default."""

    name: str = Field(description="Name of the camera.")
    width: int = Field(ge=1, le=65535, description="Columns, px.")
    height: int = Field(ge=1, le=65535, description="Rows, px.")
    pixel_pitch_um: float | None = Field(
        None, gt=0, le=1000, description="Distance between pixel centres, micrometres."
    )
    frame_gamma: Literal["linear", "srgb"] | Annotated[float, Field(gt=0, le=10)] | None = Field(
        None,
        description="Curve from codes of the camera's own frames (grey, of its size) to light, or its exponent.",
    )
    contrast_threshold: float | None = Field(None, ge=0.001, le=10, description="Nominal ON threshold, ln units.")
    contrast_threshold_off: float | None = Field(
        None, ge=0.001, le=10, description="Nominal OFF threshold; default: equal."
    )
    threshold_sigma: float | None = Field(
        None, ge=0, le=5, description="Spread of the threshold over the pixels, ln units."
    )
    cutoff_hz: float | None = Field(
        None, ge=0, le=1e7, description="Photoreceptor bandwidth in good light, Hz; 0: unlimited."
    )
    refractory_us: float | None = Field(None, ge=0, le=1e9, description="Dead time of a pixel, microseconds.")
    leak_rate_hz: float | None = Field(
        None, ge=0, le=1e4, description="Leak events per second and pixel; null: 0.01 with V2E and the Voltmeter."
    )
    shot_noise_rate_hz: float | None = Field(
        None, ge=0, le=1e4, description="Noise events per second and pixel in the dark."
    )
    emulators: Annotated[dict[str, Tree], AfterValidator(_emulator_tables)] = Field(
        {},
        description="Keys of `events:` by emulator; they override the values above.",
    )
    readout: ReadoutConfig | None = Field(None, description="Defects and latency of the pixels, the bus and its clock.")
    sources: dict[str, str] = Field(
        {},
        description="Source of each value or table, by its dotted place.",
    )
    uncertainty: dict[str, float] = Field(
        {}, description="Standard deviations of fitted values, by dotted place, in the value's unit."
    )

    @rule("#sources", "#uncertainty", "#emulators")
    def _of_values_there_are(sources: tuple, uncertainty: tuple, emulators: tuple):
        for table, names in (("sources", sources), ("uncertainty", uncertainty)):
            for name in names:
                key, *rest = name.split(".")
                known = key in SensorConfig.model_fields and key not in ("sources", "uncertainty")
                if not known or (key == "emulators" and rest and rest[0] not in emulators):
                    raise Refused("the file has no such value", where=table, value=name)

    @property
    def threshold_known(self) -> bool:
        """Return whether a threshold of its pixels is known; otherwise the emulators' defaults apply."""
        # k1 is the voltmeter's, whose threshold is 1 / k1 in ln units.
        tables = (*self.emulators.values(), {"contrast_threshold": self.contrast_threshold})
        return any(table.get(key) is not None for table in tables for key in ("contrast_threshold", "k1"))

    def values(self, emulator: object) -> Tree:
        """Return the sensor's values for the keys of the emulator of this name; none for an unknown one."""
        models = EmulatorConfig.members
        if not isinstance(emulator, str) or emulator not in models:
            return {}
        known = {key: value for key, value in models[emulator].from_sensor(self).items() if value is not None}
        return {**known, **copy.deepcopy(self.emulators.get(emulator, {}))}

    def emulator(self, emulator: str, **overrides: object) -> EmulatorConfig:
        """Return the configuration of the emulator of this name with this sensor's values, then ``overrides``. Raises
        ConfigError."""
        models = EmulatorConfig.members
        if not isinstance(emulator, str) or emulator not in models:
            raise ConfigError(
                "unknown emulator", where="events.emulator", value=emulator, accepted="one of " + ", ".join(models)
            )
        return validate(models[emulator], {**self.values(emulator), **overrides}, where="events")


def sensor_names() -> tuple[str, ...]:
    """Return the names of the shipped sensors, as ``load_sensor`` takes them."""
    return shipped_names("sensors")


def load_sensor(name: str, unit: int | None = None) -> SensorConfig:
    """Return a shipped sensor by name (ignoring case and punctuation), or one of a YAML file by its path (ending in
    .yaml or .yml). Raises ConfigError naming the known ones, or the problem with the file.

    unit : number of a unit, for a sensor whose values are distributions over units; its values depend only on this
    number. None: the middle of every distribution."""
    table = sensor_table(name)
    _check(table, str(name))
    return validate(SensorConfig, middle(table) if unit is None else draw(table, unit, 0), where=str(name))


def _check(table: Mapping[str, object], where: str) -> None:
    """Validate values that represent all that a sensor can draw. Raises ConfigError."""
    for tree in corners(table):
        validate(SensorConfig, tree, where=where)


def sensor_table(name: Any) -> Tree:
    """Return a copy of a sensor file's table, distributions included. Raises ConfigError as :func:`load_sensor`."""
    if is_sensor_file(name):
        return read_table(name, "a sensor: name, width, height, ...")
    with placed("sensor"):
        return shipped("sensors", known_sensor(_sensor(name)))


def is_sensor_file(name: object) -> bool:
    """Return whether a sensor's name is the path of a file."""
    return isinstance(name, str) and name.lower().endswith((".yaml", ".yml"))


def known_sensor(name: object) -> str | None:
    """Return the name in :func:`sensor_names` that ``name`` means; None if it is not shipped."""
    plain = lambda s: "".join(c for c in s.lower() if c.isalnum())
    return (
        next((known for known in sensor_names() if plain(known) == plain(name)), None)
        if isinstance(name, str)
        else None
    )


def sensor_file_or_name(sensor: Any, base: Path) -> object:
    """Return the value of a run's key ``sensor`` with a file's path (relative to ``base``) replaced by its table. A
    shipped sensor with distributions becomes its table, too, because a sequence must record the unit it drew; the
    others remain a name. Raises ConfigError."""
    if is_sensor_file(sensor):
        table = sensor_table(str(base / sensor))
        _check(table, str(base / sensor))
        return table
    known = known_sensor(sensor)
    table = None if known is None else shipped("sensors", known)
    return table if _has_distributions(table) else sensor


def _has_distributions(node: object) -> bool:
    if is_distribution(node):
        return True
    inside = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    return any(_has_distributions(child) for child in inside)


def fill_sensor(sensor: Any, emulator: object) -> Tree:
    """Return the keys that ``sensor``, a name or a table, gives to a configuration with ``emulator`` (None: the default
    one); none for an unknown sensor or an invalid table."""
    try:
        camera = validate(SensorConfig, sensor) if isinstance(sensor, dict) else load_sensor(sensor)
    except ConfigError:  # the check of the key sensor reports this
        return {}
    keys = {
        "camera": {"width": camera.width, "height": camera.height},
        "events": camera.values(EmulatorConfig.default_member if emulator is None else emulator),
    }
    return keys if camera.readout is None else {**keys, "readout": camera.readout.model_dump()}


def other_size(sensor: str | SensorConfig | None, width: int, height: int) -> tuple[str, ...]:
    """Return a line where a recipe states another size, px, than its sensor has."""
    if sensor is None:
        return ()
    camera = load_sensor(sensor) if isinstance(sensor, str) else sensor
    if (camera.width, camera.height) == (width, height):
        return ()
    size = f"{width}x{height} px (camera.width, camera.height)"
    return (f"the sensor {camera.name} has {camera.width}x{camera.height} px, the recipe says {size}",)


def _sensor(name: object) -> object:
    if known_sensor(name) is None:
        raise Refused(
            "unknown sensor",
            value=name,
            accepted=f"one of {', '.join(sensor_names())}, or a sensor file ending in .yaml",
        )
    return name


Sensor = Annotated[
    Annotated[Annotated[str, AfterValidator(_sensor)], Tag("one by name")] | Annotated[SensorConfig, Tag("a table")],
    Discriminator(lambda value: "a table" if isinstance(value, (dict, SensorConfig)) else "one by name"),
]
