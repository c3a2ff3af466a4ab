"""How right falling bodies are, and what they cost.

    python -m blinkgl.tools.bench_dynamics

Five bounces of a ball against the closed form (heights h e^2n, times of the tops), over rates and restitutions, from
three heights each; energy of a die on a table and of a brick that tumbles without touching anything; processor time of
random worlds. Errors are maxima; `e` is the restitution that each bounce had, by the heights before and after it.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np

from blinkgl.config.camera import CameraConfig
from blinkgl.config.physics import BodyConfig, PhysicsConfig, RandomPhysicsConfig
from blinkgl.config.scene import ObjectsConfig, RandomSceneConfig
from blinkgl.machine import bench
from blinkgl.scene.build import build_scene
from blinkgl.scene.geometry.primitives import cuboid, grid, icosphere
from blinkgl.scene.motion.dynamics import simulate
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.types import Material, Mesh, Part, PosePath, SceneObject

S, G, RADIUS = 1_000_000_000, 9.81, 0.1


def thing(name: str, mesh: Mesh, height: float = 0.0, category: str = "object") -> SceneObject:
    """A body at rest, its origin at ``height``."""
    T = np.eye(4)
    T[2, 3] = height
    return SceneObject(name, 1, (Part(mesh, Material()),), StaticPath(T), category)


def fallen(
    name: str, mesh: Mesh, height: float, seconds: float, rate: float = 20_000, ground: bool = True, **body
) -> tuple[PosePath, tuple[int, ...]]:
    """The path of one body over a floor, and the times of its impacts, ns."""
    floor = [thing("floor", grid(width=9, depth=9), category="ground")] if ground else []
    made, dynamics = simulate(
        [thing(name, mesh, height), *floor],
        {name: BodyConfig(**body)},
        PhysicsConfig(rate=rate),
        0,
        round(seconds * S),
    )
    return made[0].path, dynamics.impacts_ns


def tops(path: PosePath, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Times, s, and heights, m, at which a bouncing ball turns round in the air."""
    t = np.arange(1, round(seconds * 2000)) * (S // 2000)
    v = np.array([path.derivative(int(x))[2, 3] for x in t])
    exact = [
        int(t[k] + (t[k + 1] - t[k]) * v[k] / (v[k] - v[k + 1])) for k in np.flatnonzero((v[:-1] > 0) & (v[1:] <= 0))
    ]
    return np.array(exact) * 1e-9, path.poses(np.array(exact))[:, 2, 3]


def bounces(rate: float, e: float) -> str:
    """One row: a rate and a restitution."""
    apart, late, high, spent, simulated = [], [], [], 0.0, 0.0
    for h in (0.75, 0.9, 1.1):
        fall = math.sqrt(2 * h / G)
        wanted = [fall + sum(2 * e**k * fall for k in range(1, n)) + e**n * fall for n in range(1, 6)]
        began = time.process_time()
        path, _ = fallen("ball", icosphere(radius=RADIUS), h + RADIUS, wanted[-1] + 0.05, rate, restitution=e)
        spent, simulated = spent + time.process_time() - began, simulated + wanted[-1] + 0.05
        times, heights = (a[:5] for a in tops(path, wanted[-1] + 0.05))
        rises = np.r_[h, heights - RADIUS]
        apart += list(np.sqrt(rises[1:] / rises[:-1]) - e)
        high += list((heights - RADIUS) / (h * e ** (2 * np.arange(1, len(heights) + 1))) - 1)
        late += list(times - wanted[: len(times)])
    worst = lambda values: float(np.abs(values).max())
    return (
        f"| {rate:,.0f} | {e} | {worst(apart):.4f} ({np.mean(apart):+.4f}) | {100 * worst(high):.1f} % | "
        f"{1000 * worst(late):.1f} | {spent / simulated:.2f} |"
    )


def energies(path: PosePath, extents: tuple[float, float, float], seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Times, ns, and kinetic and potential energy of a box of 1 kg, J."""
    t = np.arange(0, round(seconds * S), 1_000_000)
    T, D = path.poses(t), np.stack([path.derivative(int(x)) for x in t])
    W = T[:, :3, :3].transpose(0, 2, 1) @ D[:, :3, :3]
    w, a = np.stack([W[:, 2, 1], W[:, 0, 2], W[:, 1, 0]], 1), np.square(extents)
    return t, 0.5 * (D[:, :3, 3] ** 2).sum(1) + 0.5 * (w**2 @ ((a.sum() - a) / 12)) + G * T[:, 2, 3]


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print(bench.machine_line())
    print("\n| steps/s | restitution | its error: max (mean) | heights | times, ms | processor s per simulated s |")
    print("|---|---|---|---|---|---|")
    for rate in (1000, 5000, 20_000, 100_000):
        for e in (0.5, 0.8):
            print(bounces(rate, e))
    die = dict(mass=1.0, restitution=0.5, friction=0.4, velocity=(1.0, 0.3, 0.0), spin=(400.0, 250.0, 100.0))
    path, impacts = fallen("die", cuboid(extents=(0.2, 0.2, 0.2)), 1.2, 2.5, **die)
    t, energy = energies(path, (0.2, 0.2, 0.2), 2.5)
    flight, free = t < impacts[0] - 3e6, np.array([np.abs(np.array(impacts) - x).min() > 3e6 for x in t])
    print(
        f"\ndie: before the first impact {np.ptp(energy[flight]) / energy[0]:.1e} of its energy, largest gain between"
    )
    print(f"milliseconds clear of impacts {max(np.diff(energy[free]).max(), 0) / energy[0]:.1e}, at rest", end=" ")
    print(f"{energy[-1] / (G * 0.1) - 1:+.1e} of what lying has")
    path, _ = fallen(
        "brick", cuboid(extents=(0.1, 0.2, 0.4)), 60.0, 3.0, ground=False, mass=1.0, spin=(800.0, 50.0, 20.0)
    )
    _, energy = energies(path, (0.1, 0.2, 0.4), 3.0)
    print(f"brick, tumbling for 3 s: {energy[-1] / energy[0] - 1:+.1e} of its energy")
    for count in (8, 20):
        settings = RandomSceneConfig(
            objects=ObjectsConfig(count=count), physics=RandomPhysicsConfig(share=1.0, thrown=0.5)
        )
        spent = []
        for sequence in range(3):
            plain = settings.model_copy(update={"physics": None})
            for scene in (plain, settings):
                began = time.process_time()
                build_scene(scene, CameraConfig(), 0, S, sequence=sequence)
                spent.append(time.process_time() - began)
        print(
            f"random world, {count} of {count} fall for 1 s: {np.median(np.subtract(spent[1::2], spent[::2])):.2f} s "
            "more"
        )


if __name__ == "__main__":
    main()
