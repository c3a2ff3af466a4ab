"""An inertial unit: motions whose forces are known by formula, a flight integrated back, noise of the asked density."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from blinkgl import ConfigError
from blinkgl.config.over_time import ImuConfig
from blinkgl.scene.motion.paths import KeyframePath, StaticPath
from blinkgl.sequence.inertial import measured, place_of

S = 1_000_000_000
RNG = np.random.default_rng


class Circle:
    """Radius 2 about the z axis at 3 rad/s, turning with it: in its own axes all is constant."""

    t0_ns, t1_ns, is_static = 0, S, False
    radius, speed = 2.0, 3.0

    def pose(self, t_ns):
        T, angle = np.eye(4), self.speed * t_ns * 1e-9
        T[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
        T[:2, 3] = self.radius * np.cos(angle), self.radius * np.sin(angle)
        return T

    def poses(self, times):
        return np.array([self.pose(t) for t in times])

    def derivative(self, t_ns):
        turn = np.zeros((4, 4))
        turn[0, 1], turn[1, 0] = -self.speed, self.speed
        D = turn @ self.pose(t_ns)
        D[3] = 0
        return D


@pytest.mark.parametrize("arm", [(0, 0, 0), (0.5, 0, 0), (-2, 0, 1), (0, 0.3, 0)])
def test_on_a_circle_it_feels_the_centre_and_the_weight(arm):
    config = ImuConfig(rate=50, position=arm, gravity=(0, 0, -9.81))
    got = measured(Circle(), config, 0, S, RNG(0))
    assert np.allclose(got.rate, (0, 0, 3), atol=1e-9)
    place = np.array([2 + arm[0], arm[1], 0])
    assert np.allclose(got.acceleration, (*(-9 * place[:2]), 9.81), atol=1e-6)
    assert np.array_equal(got.rate, got.ideal_rate) and not got.rate_bias.any()


def test_integrated_over_ten_seconds_it_gives_the_flight_back():
    rng = RNG(0)
    knots = np.arange(0, 11 * S + 1, S)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(size=(len(knots), 3)) * 0.4, axis=0))
    path = KeyframePath(knots, rng.normal(size=(len(knots), 3)), turns)
    config = ImuConfig(rate=1000, position=(0.1, -0.2, 0.05), rotation=(10, 20, 30))
    got = measured(path, config, 0, 10 * S, rng)
    T = place_of(config)
    start, D = path.pose(0) @ T, path.derivative(0) @ T
    R, p, v, dt = start[:3, :3], start[:3, 3].copy(), D[:3, 3].copy(), 1e-3
    steps = Rotation.from_rotvec(0.5 * dt * (got.rate[:-1] + got.rate[1:])).as_matrix()
    a = R @ got.acceleration[0] + config.gravity
    for k in range(10_000):
        R = R @ steps[k]
        after = R @ got.acceleration[k + 1] + config.gravity
        p += dt * v + dt * dt * (2 * a + after) / 6
        v += 0.5 * dt * (a + after)
        a = after
    end = path.pose(10 * S) @ T
    assert np.linalg.norm(p - end[:3, 3]) < 1e-3
    assert np.degrees(Rotation.from_matrix(R.T @ end[:3, :3]).magnitude()) < 1e-3


def allan(values, rate, tau):
    """Allan deviation of (N,) values at tau seconds: of the means of neighbouring stretches."""
    n = round(tau * rate)
    means = values[: len(values) // n * n].reshape(-1, n).mean(axis=1)
    return np.sqrt(0.5 * np.mean(np.diff(means) ** 2))


@pytest.mark.parametrize("rate", [50, 200])
def test_allan_deviation_is_that_of_the_densities_at_any_rate(rate):
    end = 400 * S
    still = StaticPath(None, 0, end)
    white = ImuConfig(rate=rate, accelerometer_noise_density=2e-3, gyroscope_noise_density=1.7e-4)
    got = measured(still, white, 0, end, RNG(1))
    for tau in (0.1, 1.0):
        noise = [allan(got.acceleration[:, k] - got.ideal_acceleration[:, k], rate, tau) for k in range(3)]
        assert np.mean(noise) == pytest.approx(2e-3 / np.sqrt(tau), rel=0.1)
        noise = [allan(got.rate[:, k], rate, tau) for k in range(3)]
        assert np.mean(noise) == pytest.approx(1.7e-4 / np.sqrt(tau), rel=0.1)
    walk = ImuConfig(rate=rate, accelerometer_random_walk=3e-3, gyroscope_random_walk=2e-5)
    got = measured(still, walk, 0, end, RNG(2))
    assert not got.rate_bias[0].any() and np.allclose(got.rate - got.ideal_rate, got.rate_bias)
    for tau in (1.0, 4.0):
        drift = np.sqrt(np.mean([allan(got.acceleration_bias[:, k], rate, tau) ** 2 for k in range(3)]))
        assert drift == pytest.approx(3e-3 * np.sqrt(tau / 3), rel=0.2)
        drift = np.sqrt(np.mean([allan(got.rate_bias[:, k], rate, tau) ** 2 for k in range(3)]))
        assert drift == pytest.approx(2e-5 * np.sqrt(tau / 3), rel=0.2)


def test_a_camera_whose_velocity_jumps_is_refused_and_one_that_stops_softly_is_not():
    knots, positions = np.array([0, S, 2 * S]), np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.0]])
    still = Rotation.identity(3)
    with pytest.raises(ConfigError, match=r"velocity jumps.*'at (0\.999|1) s'"):
        measured(KeyframePath(knots, positions, still, "linear"), ImuConfig(), 0, 2 * S, RNG(0))
    measured(KeyframePath(knots, positions, still, "spline"), ImuConfig(), 0, 2 * S, RNG(0))
    turns = Rotation.from_rotvec([(0, 0, 0), (0, 0, 1), (0, 0, 0)])
    with pytest.raises(ConfigError, match="velocity jumps"):
        measured(KeyframePath(knots, 0 * positions, turns, "linear"), ImuConfig(), 0, 2 * S, RNG(0))
