"""The table of emulator classes, the only place that selects by an emulator's kind.

    @register
    class Mine(Emulator):
        class Config(EmulatorConfig): ...      # name, keys, from_sensor
        def response(cls, config): ...         # the signal that timelines watch
        def noiseless(cls, config): ...        # whose events `trade` judges by
        def _start(self, frame, t_ns): ...
        def _advance(self, frame, t_ns): ...

docs/extending.md has a complete example. ``Config`` holds what configuration needs; registration passes it to
:class:`~blinkgl.config.events.EmulatorConfig`, so that the configuration room does not import this one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from blinkgl.config.base import tag_of
from blinkgl.config.events import EmulatorConfig
from blinkgl.config.problems import validate
from blinkgl.config.readout import ReadoutConfig
from blinkgl.config.sensor import SensorConfig
from blinkgl.events.emulator import Emulator
from blinkgl.events.response import Response

EMULATORS: dict[str, type[Emulator]] = {}
"""Emulators by ``Config``'s key ``emulator``."""
_SOME_SENSORS = (
    SensorConfig(name="unknown", width=4, height=3),
    SensorConfig(
        name="some",
        width=4,
        height=3,
        contrast_threshold=0.2,
        threshold_sigma=0.01,
        cutoff_hz=100,
        refractory_us=10,
        leak_rate_hz=0.1,
        shot_noise_rate_hz=0.1,
        readout=ReadoutConfig(events_per_second=1e6),
    ),
)


def register(emulator: type[Emulator]) -> type[Emulator]:
    """Check every part of a class and add it to the table; return it, for use as a decorator.

    Raises TypeError naming the emulator and the part that is missing or of the wrong kind, or a name that is in use;
    nothing is then registered."""
    kind = _checked(emulator)
    if EMULATORS.get(kind, emulator) is not emulator:
        raise TypeError(f"emulator '{kind}': there is one already, {EMULATORS[kind].__name__}")
    # Configuration gets the model alone, so it need not import this room.
    EmulatorConfig.members[kind], EMULATORS[kind] = emulator.Config, emulator
    return emulator


def emulator_of(config: EmulatorConfig) -> type[Emulator]:
    """Return the class of a configuration. Raises TypeError for one that is not in the table."""
    for emulator in EMULATORS.values():
        # Not isinstance: the configuration of an emulator may inherit from that of another.
        if type(config) is emulator.Config:
            return emulator
    raise TypeError(f"no emulator for {type(config).__name__}")


def make_emulator(config: EmulatorConfig, height: int, width: int, seed: int = 0) -> Emulator:
    """Return the emulator of a configuration, on the CPU. Raises EventDataError: a size out of range."""
    made: Callable[..., Emulator] = emulator_of(config)
    return made(height, width, config, seed)


def _checked(emulator: object) -> str:
    """Return the class's name in the table. Raises TypeError as :func:`register`."""
    if not (isinstance(emulator, type) and issubclass(emulator, Emulator)):
        raise TypeError(f"{emulator!r} is not a subclass of Emulator")
    name = emulator.__name__

    def unless(right: object, part: str, problem: str) -> None:
        if not right:
            raise TypeError(f"emulator {name}: `{part}` {problem}")

    def result(part: str, call: Callable[..., Any], *arguments: object) -> Any:
        try:
            return call(*arguments)
        except Exception as error:
            raise TypeError(f"emulator {name}: `{part}` fails: {error}") from error

    model: Any = getattr(emulator, "Config", None)
    unless(model is not None, "Config", "is missing")
    unless(
        isinstance(model, type) and issubclass(model, EmulatorConfig) and model is not EmulatorConfig,
        "Config",
        f"is {model!r} and not an EmulatorConfig of its own",
    )
    unless("emulator" in model.model_fields, "Config.emulator", "is missing")
    kind = model.model_fields["emulator"].default
    unless(
        tag_of(model) == ("emulator", kind),
        "Config.emulator",
        'is not of the form `emulator: Literal["name"] = "name"`',
    )
    name = f"'{kind}'"
    required = [key for key, info in model.model_fields.items() if info.is_required()]
    unless(not required, "Config", f"has keys without a default: {', '.join(required)}")
    # A class with abstract methods can be registered but never made: said here, not in the first run.
    for part in sorted(model.__abstractmethods__):
        unless(False, f"Config.{part}", "is missing")
    for sensor in _SOME_SENSORS:
        values = result("Config.from_sensor", model.from_sensor, sensor)
        unless(isinstance(values, dict), "Config.from_sensor", f"gives {values!r} and not a table of keys")
        values_set = {key: value for key, value in values.items() if value is not None}
        result("Config.from_sensor", validate, model, values_set)
    config = result("Config", model)

    for part in sorted(emulator.__abstractmethods__):
        unless(False, part, "is missing")
    # The timeline and the judge call both before the first frame.
    response, twin = result("response", emulator.response, config), result("noiseless", emulator.noiseless, config)
    unless(isinstance(response, Response), "response", f"gives {response!r} and not a Response")
    # This class is not in the table yet, and may be its own judge.
    known = (model, *(other.Config for other in EMULATORS.values()))
    unless(type(twin) in known, "noiseless", f"gives {twin!r} and not the configuration of an emulator in the table")
    return kind
