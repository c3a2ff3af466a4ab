"""``imu:`` and ``tracks:``: what is measured and followed over time, beside events and labels (docs/over_time.md)."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from pydantic import Field

from blinkgl.config.base import Config, Refused

# ---------------------------------------------------------------------------------------------------------------------
# ``imu:`` of the YAML: the inertial unit on the camera (:mod:`blinkgl.sequence.inertial`).

MAX_SAMPLES = 10_000_000
_Vector = tuple[float, float, float]
_NOISE = dict(ge=0, le=1e3)


class ImuConfig(Config):
    """An inertial unit fixed to the camera: what it would measure, and what it does with noise and biases. World units
    are metres. Densities are those of Kalibr's imu.yaml: of continuous time, whatever the rate."""

    presets: ClassVar[dict[str, dict[str, Any]]] = {
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
        description="gives the noise: none, or that of EuRoC's unit as its sensor.yaml has it; what is said beside it "
        "wins",
    )
    rate: float = Field(200.0, gt=0, le=1000, description="measurements per second, Hz, from the sequence's start on")
    position: _Vector = Field(
        (0.0, 0.0, 0.0), description="where it is, m, on the camera's axes: x right, y down, z forward"
    )
    rotation: _Vector = Field(
        (0.0, 0.0, 0.0),
        description="how it is turned, degrees about x, y and z of the camera's axes, one after the other; 0, 0, 0: it "
        "has the camera's axes",
    )
    gravity: _Vector = Field((0.0, 0.0, -9.81), description="acceleration of free fall, m/s², world axes")
    accelerometer_noise_density: float = Field(0.0, **_NOISE, description="white noise, m/s²/√Hz")
    accelerometer_random_walk: float = Field(0.0, **_NOISE, description="of the bias, m/s³/√Hz")
    gyroscope_noise_density: float = Field(0.0, **_NOISE, description="white noise, rad/s/√Hz")
    gyroscope_random_walk: float = Field(0.0, **_NOISE, description="of the bias, rad/s²/√Hz")
    accelerometer_bias: ClassVar[Any] = (0.0, 0.0, 0.0)
    gyroscope_bias: ClassVar[Any] = (0.0, 0.0, 0.0)
    fixed: ClassVar[Any] = ("accelerometer_bias", "gyroscope_bias")

    @property
    def noisy(self) -> bool:
        """Whether two seeds measure two things."""
        return any(
            (
                self.accelerometer_noise_density,
                self.accelerometer_random_walk,
                self.gyroscope_noise_density,
                self.gyroscope_random_walk,
            )
        )


def imu_count(rate: float, t0_ns: int, t1_ns: int) -> int:
    """Measurements in [t0, t1], both included where one falls there."""
    return int((t1_ns - t0_ns) * 1e-9 * rate + 1e-9) + 1


def imu_times(rate: float, t0_ns: int, t1_ns: int) -> list[int]:
    """When it measures, ns."""
    return [t0_ns + round(k * 1e9 / rate) for k in range(imu_count(rate, t0_ns, t1_ns))]


def check_imu(rate: float, seconds: float) -> None:
    """Raises Refused, where ``imu:`` stands, for a sequence of more measurements than are held."""
    if rate * seconds > MAX_SAMPLES:
        raise Refused(
            f"{rate * seconds:.0f} measurements",
            where="imu.rate",
            value=rate,
            accepted=f"a sequence of at most {MAX_SAMPLES} of them",
        )


# ---------------------------------------------------------------------------------------------------------------------
# ``tracks:`` of the YAML: points on surfaces that are followed through the sequence (:mod:`blinkgl.render.tracks`).

MAX_POSITIONS = 50_000_000
"""Points times times: what is held in memory."""


class TracksConfig(Config):
    """Points on surfaces, followed: where each is in the image and in the world, and whether it is seen, in
    tracks.npz."""

    points: int = Field(256, ge=1, le=1_000_000, description="how many, at most")
    choose: Literal["grid", "surface"] = Field(
        "grid",
        description="grid: what the pixels of a regular grid see at the first time; surface: places drawn evenly on "
        "the bodies' surfaces, of which those are kept that are ever seen",
    )
    rate: float | None = Field(
        None,
        gt=0,
        le=1e5,
        description="positions per second, Hz, from the first label's time on; null: at the labels' times",
    )


def track_times(rate: float | None, first_ns: int, end_ns: int, interval_ns: int) -> range:
    """Times of positions, ns: from the first label's on, one ``rate`` apart (None: a label interval)."""
    return range(first_ns, end_ns + 1, interval_ns if rate is None else max(1, round(1e9 / rate)))


def check_tracks(points: int, rate: float, seconds: float) -> None:
    """Raises Refused, where ``tracks:`` stands, for more positions than are held."""
    count = seconds * rate + 1
    if points * count > MAX_POSITIONS:
        raise Refused(
            f"{points * count:.3g} positions",
            where="tracks.points",
            value=points,
            accepted=f"at most {max(1, int(MAX_POSITIONS / count))} at {count:.0f} times, or a lower rate",
        )
