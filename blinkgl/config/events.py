"""Configurations of the event emulators: parameters, units, defaults and the source of each.

``emulator`` selects the model. ``preset`` fills in a published parameter set; a key given beside it overrides the
preset. The code of the emulators, and the table that connects both, is in :mod:`blinkgl.events.table`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Self

from pydantic import Field, model_validator

from blinkgl.config.base import Config, Former, Refused, rule
from blinkgl.types.trees import Tree

_MAX_EVENTS = Field(
    2**25,
    ge=1_000,
    le=2**31 - 1,
    description="Most events of one step, divided equally among blocks of 1024 pixels (at least one per pixel). "
    "Beyond it, every pixel of a block is cut to the same number; the manifest counts them. Sorting 2^25 events needs "
    "about 1 GB.",
)
_CAUSES = Field(
    False,
    description="Mark every event with its cause: 0 signal, 1 leak, 2 shot noise, 3 hot pixel.",
)
Device = Literal["auto", "cpu", "cuda"]
_DEVICE: Any = Field(
    "auto",
    description="Where events are computed, with the same result: `cpu`, compiled loops; `cuda`, torch on a GPU; "
    "`auto`: docs/simulators.md.",
)
_THRESHOLD = dict(ge=0.001, le=10.0)
_THRESHOLD_MAP: str | None = Field(
    None,
    description="Measured thresholds of each pixel, ln units from 0.001 to 10: a .npy file of floats, (H, W), or (2, "
    "H, W) with C+ and C-, instead of `threshold_sigma`. `contrast_threshold` stays the nominal threshold, to which "
    "noise and `timeline: brightness` refer.",
)


class Fitted(NamedTuple):
    """The range that a calibration tries for a key, > 0, in steps of constant ratio. The lower end of a noise is as
    good as none.

    usual, factor : the value that cameras have, and one standard deviation of it as a ratio (published DAVIS thresholds
    range from 0.11 to 0.56; a dark offset of 20 codes, Lin et al. 2022); None: not known."""

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


class EmulatorConfig(Config):
    """Base of the emulator configurations; a field is ``events: EmulatorConfig = EsimConfig()``. A member declares its
    name, ``emulator: Literal["..."] = "..."``, gives every key a default, and defines the attributes below."""

    members: ClassVar[dict[str, type[EmulatorConfig]]] = {}
    tag, default_member = "emulator", "esim"

    if TYPE_CHECKING:

        @property
        def emulator(self) -> str:
            """Return the emulator's name."""

    fitted: ClassVar[Mapping[str, Fitted]] = MappingProxyType({})
    """Keys that `blinkgl calibrate` estimates from a recording."""
    one_threshold: ClassVar[bool] = False
    """Whether ON and OFF events cannot be weighted separately: a calibration then uses their sum."""

    def beside(self, base: Path) -> Self:
        """Return the configuration whose files are found from anywhere: ``base`` is the folder that relative paths
        start from."""
        return self

    @classmethod
    @abstractmethod
    def from_sensor(cls, sensor: object) -> Tree:
        """Return the values of the keys that a camera's data sheet describes; None where this sensor gives none.

        sensor : a :class:`~blinkgl.config.sensor.SensorConfig`, which knows the emulators' keys."""


def _pixel(sensor: Any) -> dict[str, object]:
    return dict(
        contrast_threshold=sensor.contrast_threshold,
        contrast_threshold_off=sensor.contrast_threshold_off,
        threshold_sigma=sensor.threshold_sigma,
        refractory_us=sensor.refractory_us,
    )


class _TwoThresholds(EmulatorConfig):
    """Shared by emulators with ``contrast_threshold``, ``contrast_threshold_off`` and ``threshold_ratio``."""

    spread: ClassVar[float | None] = None
    """Standard deviation of the thresholds by the threshold itself: the default of ``threshold_sigma`` where a
    threshold is given."""

    if TYPE_CHECKING:
        contrast_threshold: float
        contrast_threshold_off: float | None
        threshold_map: str | None

    def beside(self, base: Path) -> Self:
        if self.threshold_map is None:
            return self
        return self.model_copy(update={"threshold_map": str(base / Path(self.threshold_map).expanduser())})

    @property
    def thresholds(self) -> tuple[float, float]:
        """Return C+ and C-, ln units."""
        return self.contrast_threshold, self.contrast_threshold_off or self.contrast_threshold

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, data: object) -> object:
        """Return the keys with those that follow from others: the missing threshold from the given one and the ratio,
        and the spread. Values that are no numbers are left to validation."""
        if not isinstance(data, dict):
            return data
        ratio, default = data.get("threshold_ratio"), cls.model_fields["contrast_threshold"].default
        basis, missing = "contrast_threshold", "contrast_threshold_off"
        if data.get(missing) is not None:
            basis, missing = missing, basis
        if ratio is not None and data.get(missing) is None:
            try:
                data = {**data, missing: float(data.get(basis, default)) * float(ratio)}
            except (TypeError, ValueError, OverflowError):
                return data
        if cls.spread is not None and "threshold_sigma" not in data and data.get("contrast_threshold") is not None:
            try:
                sigma = cls.spread * float(data["contrast_threshold"])  # YAML reads 1e-1 as text
            except (TypeError, ValueError, OverflowError):
                return data
            data = {**data, "threshold_sigma": sigma or cls.model_fields["threshold_sigma"].default}
        return data

    @rule("threshold_ratio", "contrast_threshold", "contrast_threshold_off")
    def _the_ratio_is_theirs(ratio: float | None, on: float, off: float):
        if ratio is not None and not any(math.isclose(off, on * r, rel_tol=1e-6) for r in (ratio, 1 / ratio)):
            raise Refused(
                "not the ratio of the two thresholds",
                where="threshold_ratio",
                value=ratio,
                accepted=f"one of them, or {off / on:.6g}",
            )


_NO_CORRELATION = {"threshold_correlation": Former("the key left out", lambda value: value == 0)}


class EsimConfig(_TwoThresholds):
    """ESIM (Rebecq, Gehrig, Scaramuzza, CoRL 2018): log intensity against per-pixel levels, linear in time."""

    fitted = _ESIM_FITTED
    former = _NO_CORRELATION
    # 0.021 of 0.2. An absolute one would make a pixel that is set to a small threshold fire at many others.
    spread = 0.105
    emulator: Literal["esim"] = "esim"
    contrast_threshold: float = Field(
        0.2,
        **_THRESHOLD,
        description="C+, change of ln(intensity) per ON event.",
    )
    contrast_threshold_off: float | None = Field(
        None, **_THRESHOLD, description="C-, for OFF events; default: equal to contrast_threshold."
    )
    threshold_ratio: float | None = Field(
        None,
        ge=0.01,
        le=100,
        description="OFF threshold / contrast_threshold, instead of contrast_threshold_off; where only "
        "contrast_threshold_off is given, ON / OFF.",
    )
    threshold_sigma: float = Field(
        0.021,
        ge=0,
        le=5,
        description="Standard deviation of C+ and C- over the pixels, ln units; each threshold stays >= 0.01 (or >= "
        "half of a smaller nominal one). Default: 10.5 % of contrast_threshold.",
    )
    threshold_map: str | None = _THRESHOLD_MAP
    threshold_jitter: float = Field(
        0.0,
        ge=0,
        le=5,
        description="Standard deviation of the threshold from event to event, ln units.",
    )
    log_eps: float = Field(
        1e-3,
        ge=1e-9,
        le=1e6,
        description="Added to the intensity before the logarithm.",
    )
    refractory_us: float = Field(
        0.0,
        ge=0,
        le=1e9,
        description="Dead time after an event, microseconds; a level crossed during it is lost.",
    )
    max_events_per_step: int = _MAX_EVENTS
    causes: bool = _CAUSES
    device: Device = _DEVICE

    @classmethod
    def from_sensor(cls, sensor: object) -> Tree:
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
    "compat": Former(
        "the key left out; docs/sensors.md says how these events differ from those of the authors' programs",
        lambda value: value == "none",
    )
}
_NO_SECOND_CORNER = {"second_cutoff_hz": Former("the key left out, and a lower cutoff_hz", lambda value: value == 0)}


class V2eConfig(_TwoThresholds):
    """V2E (Hu, Liu, Delbruck, CVPRW 2021): finite bandwidth, mismatch, leak, shot noise, refractory period."""

    presets = V2E_PRESETS
    fitted = _V2E_FITTED
    former: ClassVar[dict[str, Former]] = {**_NO_COMPAT, **_NO_CORRELATION, **_NO_SECOND_CORNER}
    emulator: Literal["v2e"] = "v2e"
    preset: Literal["default", "clean", "noisy"] = Field(
        "default", description="v2e's command-line defaults, or its `clean` and `noisy` parameter sets."
    )
    contrast_threshold: float = Field(0.2, **_THRESHOLD, description="ON threshold, ln units.")
    contrast_threshold_off: float | None = Field(None, **_THRESHOLD, description="OFF threshold; default: equal.")
    threshold_ratio: float | None = Field(
        None,
        ge=0.01,
        le=100,
        description="OFF threshold / contrast_threshold, instead of contrast_threshold_off; where only "
        "contrast_threshold_off is given, ON / OFF.",
    )
    threshold_sigma: float = Field(
        0.03,
        ge=0,
        le=5,
        description="Spread of the thresholds over the pixels, ln units; each threshold stays >= 0.01.",
    )
    threshold_map: str | None = _THRESHOLD_MAP
    full_scale: float = Field(
        255.0,
        gt=0,
        le=1e9,
        description="Digital number of luminance 1.0; v2e's constants refer to 8-bit values.",
    )
    cutoff_hz: float = Field(
        300.0,
        ge=0,
        le=1e7,
        description="Photoreceptor cut-off at full scale, Hz, scaled by (I + 20)/275; 0: infinite bandwidth.",
    )
    leak_rate_hz: float = Field(0.01, ge=0, le=1e4, description="Leak events per second and pixel, ON.")
    leak_jitter: float = Field(
        0.1,
        ge=0,
        le=1,
        description="Relative standard deviation of the interval between leak events.",
    )
    leak_cov_decades: float = Field(
        0.1,
        ge=0,
        le=3,
        description="Spread of the leak rate over the pixels, decades.",
    )
    shot_noise_rate_hz: float = Field(
        0.001,
        ge=0,
        le=1e4,
        description="Noise events per second and pixel in the dark, ON and OFF together; a quarter of it at full "
        "scale.",
    )
    photoreceptor_noise: bool = Field(
        False,
        description="Shot noise from low-passed noise before the comparator, at the same rate; needs cutoff_hz > 0.",
    )
    refractory_us: float = Field(500.0, ge=0, le=1e9, description="Dead time after an event, microseconds.")
    start: Literal["stationary", "balanced", "zero"] = Field(
        "stationary",
        description="Pixels at the first frame. `stationary`: as after a long time before a still scene, in which "
        "leak moves pixels towards ON, so that short clips have more ON events. `balanced`: as after a signal that "
        "rose as often as it fell. `zero`: every pixel has just fired, as in v2e.",
    )
    hot_pixel_fraction: float = Field(0.0, ge=0, le=1, description="Fraction of pixels that fire without a signal.")
    hot_pixel_rate_hz: float = Field(100.0, ge=0, le=1e5, description="Mean rate of a hot pixel, Hz, ON.")
    max_events_per_step: int = _MAX_EVENTS
    causes: bool = _CAUSES
    device: Device = _DEVICE

    @rule("photoreceptor_noise", "cutoff_hz")
    def _noise_needs_bandwidth(noise, cutoff_hz):
        if noise and cutoff_hz == 0:
            raise Refused("photoreceptor_noise needs cutoff_hz > 0 and not infinite bandwidth")

    @classmethod
    def from_sensor(cls, sensor: Any) -> Tree:
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
    former = _NO_COMPAT
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
    k4: float = Field(
        1e-7, ge=-1, le=1, description="Temperature-dependent leak (junction leakage), thresholds per us."
    )
    k5: float = Field(5e-9, ge=-1, le=1, description="Leak by parasitic photocurrent, thresholds per us and DN.")
    k6: float = Field(1e-5, ge=0, le=1, description="Circuit noise, thresholds per sqrt(us).")
    full_scale: float = Field(
        255.0, gt=0, le=1e9, description="Digital number of luminance 1.0 (the constants are on the 8-bit scale)."
    )
    refractory_us: float = Field(
        0.0, ge=0, le=1e9, description="Dead time after an event, microseconds (the paper has none)."
    )
    start: Literal["stationary", "zero"] = Field(
        "stationary",
        description="V at the first frame: as after a long time before a still scene, or 0, as in the authors' "
        "program.",
    )
    max_events_per_step: int = _MAX_EVENTS
    causes: bool = _CAUSES

    @classmethod
    def from_sensor(cls, sensor: Any) -> Tree:
        """Return the constants of the nearest calibrated camera, with the sensor's threshold and noise.

        The leak is the drift k4 of a still pixel, as the preset's is of one camera in one light; unknown, it is V2E's.
        In the dark only k6 diffuses: mean time to leave (-1, 1) is 1/k6^2, so the noise rate gives k6."""
        gain = None if sensor.contrast_threshold is None else 1 / sensor.contrast_threshold
        leak = V2eConfig.model_fields["leak_rate_hz"].default if sensor.leak_rate_hz is None else sensor.leak_rate_hz
        noise = None if sensor.shot_noise_rate_hz is None else (sensor.shot_noise_rate_hz * 1e-6) ** 0.5
        common = {"preset": "DVS346", "refractory_us": sensor.refractory_us, "k1": gain}
        return {**common, "k4": leak * 1e-6, "k5": 0.0, "k6": noise}


EmulatorConfig.members |= {"esim": EsimConfig, "v2e": V2eConfig, "voltmeter": VoltmeterConfig}
