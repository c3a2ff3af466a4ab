"""The same scene before five event cameras: their thresholds, dead times and numbers of events."""

import json
from pathlib import Path

from blinkgl import Camera, Esim, Keyframes, Material, Primitive, Renderer, Scene, load_sensor, look_at


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    flight = Keyframes({0: look_at((-2, -0.1, 0.6), (0, 0, 0)), 0.1: look_at((-2, 0.1, 0.6), (0, 0, 0))})
    scene = Scene(Camera(160, 120, pose=flight)) + Primitive("cuboid", material=Material(procedural="value"))
    with Renderer(scene) as renderer:
        frames = [(renderer.luminance(k / 300), round(k / 300 * 1e9)) for k in range(31)]
    counts = {}
    for name in ("davis240c", "davis346", "dvxplorer", "gen31_vga", "imx636"):
        sensor, emulator = load_sensor(name), Esim(120, 160, sensor=name, seed=1)
        counts[name] = sum(len(emulator.step(frame, t_ns)) for frame, t_ns in frames)
        pixel = emulator.config
        print(
            f"{sensor.name:27} {sensor.width:4} x {sensor.height:<4} threshold {pixel.contrast_threshold:.2f}, "
            f"dead time {pixel.refractory_us:5.0f} µs: {counts[name]} events of 160 x 120 px"
        )
    (out / "counts.json").write_text(json.dumps(counts))


def test_final(out: Path) -> None:
    counts = json.loads((out / "counts.json").read_text())
    assert len(counts) == 5 and min(counts.values()) > 500 and len(set(counts.values())) > 2


if __name__ == "__main__":
    main(Path("out/examples/sensors"))
