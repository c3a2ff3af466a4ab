"""Two recordings compared: one scene, seen by an ideal sensor and by a noisy one."""

import json
from pathlib import Path

from blinkgl import Camera, Keyframes, Material, Primitive, Scene, compare, look_at, record, write_events


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    flight = Keyframes({0: look_at((-2, -0.5, 0.6), (0, 0, 0)), 0.3: look_at((-2, 0.5, 0.6), (0, 0, 0))})
    scene = Scene(Camera(120, 90, pose=flight), duration=0.2) + Primitive("cuboid", material=Material(procedural="fbm"))
    for name, emulator in {"ideal": "esim", "noisy": {"emulator": "v2e", "preset": "noisy"}}.items():
        write_events(out / f"{name}.h5", record(scene, emulator=emulator, labels=[]).events, 90, 120)

    result = compare(out / "ideal.h5", out / "noisy.h5")
    for quantity, a, b in result.rows()[1:5] + result.rows()[-3:]:
        print(f"{quantity:47} {a:>12} {b:>24}".rstrip())
    (out / "comparison.json").write_text(json.dumps(result.to_dict()))


def test_final(out: Path) -> None:
    result = json.loads((out / "comparison.json").read_text())
    assert 0.3 < result["pixel_correlation"] < 1 and result["a"]["count"] > 1000 and result["b"]["count"] > 1000


if __name__ == "__main__":
    main(Path("out/examples/compare_recordings"))
