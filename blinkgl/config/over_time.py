"""The ``imu:`` and ``tracks:`` sections: time series beside events and labels (docs/labels.md)."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from blinkgl.config.base import Config, Refused, always
from blinkgl.types.trees import Tree

# ---------------------------------------------------------------------------------------------------------------------
# The ``imu:`` section: the inertial unit on the camera (:mod:`blinkgl.sequence.inertial`).

MAX_SAMPLES = 10_000_000
_Vector = tuple[float, float, float]
_NOISE = dict(ge=0, le=1e3)


class ImuConfig(Config):
    """An inertial unit on the camera (docs/labels.md). World units are metres; noise densities are Kalibr's."""

    presets: ClassVar[dict[str, Tree]] = {
        "ideal": {},
        "adis16448": {
            "accelerometer_noise_density": 2.0e-3,
            "accelerometer_random_walk": 3.0e-3,
            "gyroscope_noise_density": 1.6968e-4,
            "gyroscope_random_walk": 1.9393e-5,
        },
    }

    preset: Literal["ideal", "adis16448"] = Field(
        "ideal",
        description="noise. ideal: none; adis16448: EuRoC's; keys beside it override it",
    )
    rate: float = Field(200.0, gt=0, le=1000, description="measurements per second, Hz, from the sequence's start")
    position: _Vector = Field((0.0, 0.0, 0.0), description="m, in the camera's axes: x right, y down, z forward")
    rotation: _Vector = Field(
        (0.0, 0.0, 0.0),
        description="degrees about the camera's x, y and z axes, in this order",
    )
    gravity: _Vector = Field((0.0, 0.0, -9.81), description="gravitational acceleration, m/s², world axes")
    accelerometer_noise_density: float = Field(0.0, **_NOISE, description="white noise, m/s²/√Hz")
    accelerometer_random_walk: float = Field(0.0, **_NOISE, description="random walk of the bias, m/s³/√Hz")
    gyroscope_noise_density: float = Field(0.0, **_NOISE, description="white noise, rad/s/√Hz")
    gyroscope_random_walk: float = Field(0.0, **_NOISE, description="random walk of the bias, rad/s²/√Hz")
    former = dict.fromkeys(("accelerometer_bias", "gyroscope_bias"), always((0.0, 0.0, 0.0)))

    @property
    def noisy(self) -> bool:
        """Return whether two seeds give different measurements."""
        return any(
            (
                self.accelerometer_noise_density,
                self.accelerometer_random_walk,
                self.gyroscope_noise_density,
                self.gyroscope_random_walk,
            )
        )


def imu_count(rate: float, t0_ns: int, t1_ns: int) -> int:
    """Return the number of measurements in [t0, t1], both ends included."""
    # 1e-9, so that rounding does not lose a measurement at the very end.
    return int((t1_ns - t0_ns) * 1e-9 * rate + 1e-9) + 1


def imu_times(rate: float, t0_ns: int, t1_ns: int) -> list[int]:
    """Return the times of the measurements, ns."""
    return [t0_ns + round(k * 1e9 / rate) for k in range(imu_count(rate, t0_ns, t1_ns))]


def check_imu(rate: float, seconds: float) -> None:
    """Raise Refused for a sequence with more measurements than fit into memory."""
    if rate * seconds > MAX_SAMPLES:
        raise Refused(
            f"{rate * seconds:.0f} measurements",
            where="imu.rate",
            value=rate,
            accepted=f"at most {MAX_SAMPLES} in a sequence",
        )


# ---------------------------------------------------------------------------------------------------------------------
# The ``tracks:`` section: points on surfaces that are followed through the sequence (:mod:`blinkgl.render.tracks`).

MAX_POSITIONS = 50_000_000
"""Largest number of points times the number of times, all of which are held in memory."""


class TracksConfig(Config):
    """Points on surfaces that are followed, in tracks.npz (docs/labels.md)."""

    points: int = Field(256, ge=1, le=1_000_000, description="largest number of points")
    choose: Literal["grid", "surface"] = Field(
        "grid",
        description="grid: what a regular grid of pixels shows at the first time; surface: points drawn evenly on "
        "surfaces",
    )
    rate: float | None = Field(
        None,
        gt=0,
        le=1e5,
        description="positions per second, Hz, from the first label's time; null: at the labels' times",
    )


def track_times(rate: float | None, first_ns: int, end_ns: int, interval_ns: int) -> range:
    """Return the times of positions, ns: from the first label's time, at ``rate`` (None: the label interval)."""
    return range(first_ns, end_ns + 1, interval_ns if rate is None else max(1, round(1e9 / rate)))


def check_tracks(points: int, rate: float, seconds: float) -> None:
    """Raise Refused for more positions than fit into memory."""
    count = seconds * rate + 1
    if points * count > MAX_POSITIONS:
        raise Refused(
            f"{points * count:.3g} positions",
            where="tracks.points",
            value=points,
            accepted=f"at most {max(1, int(MAX_POSITIONS / count))} at {count:.0f} times, or a lower rate",
        )
