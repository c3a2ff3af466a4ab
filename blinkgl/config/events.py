"""Event emulators: parameters, units, defaults and where each comes from.

``emulator`` picks the model; ``preset`` fills in published parameter sets, and any key given beside it wins over the
preset. What configuration has to know of an emulator stands in its model here; what runs, and the
table of both, in :mod:`blinkgl.events.table`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

from pydantic import Field

from blinkgl.config.base import Family, Members, Refused, Removed, rule

if TYPE_CHECKING:
    from blinkgl.config.sensor import SensorConfig

_MAX_EVENTS = Field(
    2**25,
    ge=1_000,
    le=2**31 - 1,
    description="Most events one step may emit, shared out equally among blocks "
    "of 1024 pixels (a block may always emit one per pixel). Where more could fire, each pixel of the block "
    "is cut to the same number; levels still move, the cut events are counted in `emulator.saturated`. "
    "2^25 events need about 1 GB while they are sorted.",
)
_CAUSES = Field(
    False,
    description="Mark every event by what caused it (`Events.cause`; `events/cause` in HDF5, `cause` in .npz): "
    "0 signal, 1 leak, 2 shot noise, 3 hot pixel. The events are the same.",
)
Device = Literal["auto", "cpu", "cuda"]
_DEVICE: Any = Field(
    "auto",
    description="Where events are made: `cpu`, by compiled loops; `cuda`, by torch on a card, which takes frames that "
    "the same card has drawn without moving them (straight lines between frames alone). The events are the same. "
    "`auto`: `cuda` where a card draws the frames, torch has a card and a short trial gives the same events; else "
    "`cpu`.",
)
_THRESHOLD = dict(ge=0.001, le=10.0)


class Fitted(NamedTuple):
    """Ends of what a calibration tries for a key, more than 0; it goes in steps of a ratio. The lower end of a noise is
    as good as none.

    usual, factor : what cameras have, and one standard deviation of it as a ratio (thresholds of DAVIS settings from
    0.11 to 0.56 have been published; a dark offset of 20 codes, Lin et al. 2022); None: nothing is known."""

    low: float
    high: float
    usual: float | None = None
    factor: float = 1.0

    @property
    def ends(self) -> tuple[float, float]:
        return self.low, self.high


_THRESHOLD_FITTED = Fitted(0.05, 1.5, 0.3, 1.6)
_REFRACTORY_FITTED = Fitted(10.0, 10_000.0, 500.0, 5.0)

_ESIM_FITTED = {
    "contrast_threshold": _THRESHOLD_FITTED,
    "contrast_threshold_off": _THRESHOLD_FITTED,
    "threshold_sigma": Fitted(0.003, 0.3, 0.03, 2.5),
    "log_eps": Fitted(1e-3, 0.16, 0.01, 1.5),
    "refractory_us": _REFRACTORY_FITTED,
}

_V2E_FITTED = {
    "contrast_threshold": _THRESHOLD_FITTED,
    "contrast_threshold_off": _THRESHOLD_FITTED,
    "threshold_sigma": Fitted(0.003, 0.3, 0.03, 2.5),
    "full_scale": Fitted(40.0, 1500.0, 255.0, 1.5),
    "cutoff_hz": Fitted(20.0, 3000.0, 300.0, 3.0),
    "leak_rate_hz": Fitted(1e-3, 10.0),
    "leak_cov_decades": Fitted(0.02, 1.5),
    "shot_noise_rate_hz": Fitted(1e-3, 30.0),
    "refractory_us": _REFRACTORY_FITTED,
    "hot_pixel_fraction": Fitted(1e-5, 0.05),
    "hot_pixel_rate_hz": Fitted(1.0, 10_000.0),
}

_VOLTMETER_FITTED = {
    "k1": Fitted(0.7, 20.0, 3.3, 1.6),
    "k2": Fitted(1.0, 100.0, 10.0, 1.5),
    "k3": Fitted(1e-6, 0.1),
    "k4": Fitted(1e-9, 1e-5),
    "k5": Fitted(1e-10, 1e-6),
    "k6": Fitted(1e-6, 1e-2),
    "refractory_us": _REFRACTORY_FITTED,
}


class EmulatorConfig(Family):
    """The configuration of any emulator; a field is ``events: EmulatorConfig = EsimConfig()``. A member declares its
    name, ``emulator: Literal["..."] = "..."``, takes no argument without a default, and says what stands here."""

    members: ClassVar[Members[EmulatorConfig]] = Members("emulator", default="esim")

    if TYPE_CHECKING:

        @property
        def emulator(self) -> str:
            """The name."""

    fitted: ClassVar[Mapping[str, Fitted]] = MappingProxyType({})
    """Keys that `blinkgl calibrate` finds from a recording."""
    one_threshold: ClassVar[bool] = False
    """Nothing of it says how many events are ON and how many OFF: a calibration then asks for both together."""

    @classmethod
    @abstractmethod
    def from_sensor(cls, sensor: SensorConfig) -> dict[str, Any]:
        """Values of those of its keys of which a camera's data sheet says something; None where this one does not."""


def _with_both_thresholds(data: dict[str, Any], default: float) -> dict[str, Any]:
    """The threshold that is not given, from the one that is and ``threshold_ratio``."""
    ratio, off = data.get("threshold_ratio"), data.get("contrast_threshold_off")
    if ratio is None or (off is not None and "contrast_threshold" in data):
        return data
    given, other = "contrast_threshold", "contrast_threshold_off"
    if off is not None:
        given, other = other, given
    try:
        return {**data, other: float(data.get(given, default)) * float(ratio)}
    except (TypeError, ValueError, OverflowError):
        return data


def _pixel(sensor: SensorConfig) -> dict[str, Any]:
    return dict(
        contrast_threshold=sensor.contrast_threshold,
        contrast_threshold_off=sensor.contrast_threshold_off,
        threshold_sigma=sensor.threshold_sigma,
        refractory_us=sensor.refractory_us,
    )


class _TwoThresholds:
    """What holds for emulators with ``contrast_threshold``, ``contrast_threshold_off`` and ``threshold_ratio``."""

    if TYPE_CHECKING:
        model_fields: ClassVar[dict[str, Any]]

    @classmethod
    def completed(cls, data: dict[str, Any]) -> dict[str, Any]:
        return _with_both_thresholds(data, cls.model_fields["contrast_threshold"].default)

    @rule("threshold_ratio", "contrast_threshold", "contrast_threshold_off")
    def _the_ratio_is_theirs(ratio: float | None, on: float, off: float):
        if ratio is not None and not any(math.isclose(off, on * r, rel_tol=1e-6) for r in (ratio, 1 / ratio)):
            raise Refused(
                "is not the ratio of the two thresholds that are given beside it",
                where="threshold_ratio",
                value=ratio,
                accepted=f"one of them, or {off / on:.6g}",
            )


_NO_CORRELATION = {"threshold_correlation": Removed("the key left out", lambda value: value == 0)}


class EsimConfig(_TwoThresholds, EmulatorConfig):
    """ESIM (Rebecq, Gehrig, Scaramuzza, CoRL 2018): log intensity against per-pixel levels, linear in time."""

    fitted = _ESIM_FITTED
    removed = _NO_CORRELATION
    emulator: Literal["esim"] = "esim"
    contrast_threshold: float = Field(
        0.2,
        **_THRESHOLD,
        description="C+, change of ln(intensity) per ON event. BlinkSim draws 0.18-0.25 per sequence.",
    )
    contrast_threshold_off: float | None = Field(
        None, **_THRESHOLD, description="C-, for OFF events; default: equal to contrast_threshold."
    )
    threshold_ratio: float | None = Field(
        None,
        ge=0.01,
        le=100,
        description="OFF threshold over contrast_threshold, instead of contrast_threshold_off; or, where only that is "
        "given, ON over OFF.",
    )
    threshold_sigma: float = Field(
        0.021,
        ge=0,
        le=5,
        description="Standard deviation of C+ and C- over the pixels, in ln "
        "units (rpg_esim's default 0.021), drawn once per pixel; each threshold stays >= 0.01 "
        "(or >= half of a smaller nominal one).",
    )
    threshold_jitter: float = Field(
        0.0,
        ge=0,
        le=5,
        description="Standard deviation of the threshold from event to event, in ln units, drawn once per event.",
    )
    log_eps: float = Field(
        1e-3,
        ge=1e-9,
        le=1e6,
        description="Added to the intensity before the logarithm, in the units "
        "of the intensity (rpg_esim's default 1e-3 for intensities in [0, 1]).",
    )
    refractory_us: float = Field(
        0.0,
        ge=0,
        le=1e9,
        description="Dead time of a pixel after an event, microseconds; a level passed in it is lost, as in rpg_esim.",
    )
    max_events_per_step: int = _MAX_EVENTS
    causes: bool = _CAUSES
    device: Device = _DEVICE

    @classmethod
    def from_sensor(cls, sensor: SensorConfig) -> dict[str, Any]:
        return _pixel(sensor)


V2E_PRESETS = {
    # v2e's `--dvs_params clean` and `noisy` (emulator.py, set_dvs_params).
    "clean": dict(
        threshold_sigma=0.02,
        cutoff_hz=0.0,
        leak_rate_hz=0.0,
        leak_jitter=0.0,
        leak_cov_decades=0.0,
        shot_noise_rate_hz=0.0,
        refractory_us=0.0,
    ),
    "noisy": dict(
        threshold_sigma=0.05,
        cutoff_hz=30.0,
        leak_rate_hz=0.1,
        leak_jitter=0.1,
        leak_cov_decades=0.1,
        shot_noise_rate_hz=5.0,
        refractory_us=0.0,
    ),
}


_NO_COMPAT = {
    "compat": Removed(
        "the key left out; docs/concepts.md says how near these events are to those of the authors' programs",
        lambda value: value == "none",
    )
}
_NO_SECOND_CORNER = {"second_cutoff_hz": Removed("the key left out, and a lower cutoff_hz", lambda value: value == 0)}


class V2eConfig(_TwoThresholds, EmulatorConfig):
    """V2E (Hu, Liu, Delbruck, CVPRW 2021): finite bandwidth, mismatch, leak, shot noise, refractory period."""

    presets = V2E_PRESETS
    fitted = _V2E_FITTED
    removed: ClassVar[Any] = {**_NO_COMPAT, **_NO_CORRELATION, **_NO_SECOND_CORNER}
    emulator: Literal["v2e"] = "v2e"
    preset: Literal["default", "clean", "noisy"] = Field(
        "default", description="v2e's command-line defaults, or its `clean` and `noisy` parameter sets."
    )
    contrast_threshold: float = Field(0.2, **_THRESHOLD, description="ON threshold, ln units (v2e: 0.2).")
    contrast_threshold_off: float | None = Field(None, **_THRESHOLD, description="OFF threshold; default: equal.")
    threshold_ratio: float | None = Field(
        None,
        ge=0.01,
        le=100,
        description="OFF threshold over contrast_threshold, instead of contrast_threshold_off; or, where only that is "
        "given, ON over OFF.",
    )
    threshold_sigma: float = Field(
        0.03,
        ge=0,
        le=5,
        description="Spread of the thresholds over the pixels, ln units (v2e: 0.03); each threshold stays >= 0.01.",
    )
    full_scale: float = Field(
        255.0,
        gt=0,
        le=1e9,
        description="Digital number of luminance 1.0: v2e's lin-log joint (20) and its 275 are on the 8-bit scale.",
    )
    cutoff_hz: float = Field(
        300.0,
        ge=0,
        le=1e7,
        description="Photoreceptor cut-off at full scale, Hz (v2e: 300), scaled by "
        "(I + 20)/275; 0: infinite bandwidth.",
    )
    leak_rate_hz: float = Field(0.01, ge=0, le=1e4, description="Leak events per second and pixel, ON (v2e: 0.01).")
    leak_jitter: float = Field(
        0.1,
        ge=0,
        le=1,
        description="Relative standard deviation of the interval between two leak "
        "events of a pixel (v2e: leak_jitter_fraction 0.1).",
    )
    leak_cov_decades: float = Field(
        0.1,
        ge=0,
        le=3,
        description="Spread of the leak rate over the pixels, decades (v2e: noise_rate_cov_decades 0.1).",
    )
    shot_noise_rate_hz: float = Field(
        0.001,
        ge=0,
        le=1e4,
        description="Noise events per second and pixel in the dark, ON and "
        "OFF together (v2e: 0.001); at full scale a quarter of it.",
    )
    photoreceptor_noise: bool = Field(
        False,
        description="Make the noise events by low-passed noise before the comparator, "
        "at the rate shot_noise_rate_hz, instead of drawing events; needs cutoff_hz > 0.",
    )
    refractory_us: float = Field(500.0, ge=0, le=1e9, description="Dead time after an event, microseconds (v2e: 500).")
    start: Literal["stationary", "balanced", "zero"] = Field(
        "stationary",
        description="Where a pixel stands between its levels at the first frame. `stationary`: as in a still scene "
        "that was watched for long, which leak has brought nearer to ON (each pixel to another place): short clips "
        "then have more ON events than a scene that has been moving. `balanced`: as after a signal that went up as "
        "often as down. `zero`: every pixel has just fired, as v2e starts. Without leak the first and the last are "
        "the same.",
    )
    hot_pixel_fraction: float = Field(0.0, ge=0, le=1, description="Share of pixels that fire by themselves.")
    hot_pixel_rate_hz: float = Field(100.0, ge=0, le=1e5, description="Mean rate of a hot pixel, Hz, ON.")
    max_events_per_step: int = _MAX_EVENTS
    causes: bool = _CAUSES
    device: Device = _DEVICE

    @rule("photoreceptor_noise", "cutoff_hz")
    def _noise_needs_bandwidth(noise, cutoff_hz):
        if noise and cutoff_hz == 0:
            raise Refused("photoreceptor_noise needs cutoff_hz > 0 and not infinite bandwidth")

    @classmethod
    def from_sensor(cls, sensor: SensorConfig) -> dict[str, Any]:
        return {
            **_pixel(sensor),
            "cutoff_hz": sensor.cutoff_hz,
            "leak_rate_hz": sensor.leak_rate_hz,
            "shot_noise_rate_hz": sensor.shot_noise_rate_hz,
        }


VOLTMETER_PRESETS = {
    # Lin, Ma, Guo, Wen, "DVS-Voltmeter", ECCV 2022, calibrated k1..k6 of the two cameras.
    "DVS346": dict(k1=5.265, k2=20.0, k3=1e-4, k4=1e-7, k5=5e-9, k6=1e-5),
    "DVS240": dict(k1=4.424, k2=23.0, k3=2e-4, k4=1e-7, k5=5e-8, k6=1e-5),
}


class VoltmeterConfig(EmulatorConfig):
    """DVS-Voltmeter (Lin et al., ECCV 2022): Brownian motion with drift between two absorbing thresholds."""

    presets = VOLTMETER_PRESETS
    fitted = _VOLTMETER_FITTED
    removed = _NO_COMPAT
    one_threshold = True
    emulator: Literal["voltmeter"] = "voltmeter"
    preset: Literal["DVS346", "DVS240"] = Field(
        "DVS346", description="Camera whose calibrated k1...k6 are the defaults."
    )
    k1: float = Field(
        5.265,
        gt=0,
        le=100,
        description="Gain: thresholds per unit of d ln(L + k2); the contrast threshold is about 1/k1.",
    )
    k2: float = Field(20.0, gt=0, le=1e4, description="Dark-current offset, digital numbers.")
    k3: float = Field(1e-4, ge=0, le=1, description="Photon shot noise, sqrt(DN) per sqrt(us).")
    k4: float = Field(1e-7, ge=-1, le=1, description="Leak by temperature (junction leakage), thresholds per us.")
    k5: float = Field(5e-9, ge=-1, le=1, description="Leak by parasitic photocurrent, thresholds per us and DN.")
    k6: float = Field(1e-5, ge=0, le=1, description="Noise of the circuit, thresholds per sqrt(us).")
    full_scale: float = Field(
        255.0, gt=0, le=1e9, description="Digital number of luminance 1.0 (the constants are on the 8-bit scale)."
    )
    refractory_us: float = Field(
        0.0, ge=0, le=1e9, description="Dead time after an event, microseconds (the paper has none)."
    )
    start: Literal["stationary", "zero"] = Field(
        "stationary",
        description="V at the first frame: as of a scene that has stood still for long, or 0 everywhere (as in the "
        "authors' program: the first leak events of a flat image then come together).",
    )
    max_events_per_step: int = _MAX_EVENTS
    causes: bool = _CAUSES

    @classmethod
    def from_sensor(cls, sensor: SensorConfig) -> dict[str, Any]:
        """The constants of the nearest calibrated camera, with the gain that the threshold asks for."""
        gain = None if sensor.contrast_threshold is None else 1 / sensor.contrast_threshold
        return {"preset": "DVS346", "refractory_us": sensor.refractory_us, "k1": gain}


for _model in (EsimConfig, V2eConfig, VoltmeterConfig):
    EmulatorConfig.members.add(_model)
