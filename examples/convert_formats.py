"""Event files from one format to another: the same events in HDF5, Prophesee's EVT3, CSV and NumPy."""

from pathlib import Path

import numpy as np

from blinkgl import (
    Camera,
    Keyframes,
    Material,
    Primitive,
    Scene,
    convert,
    look_at,
    open_events,
    read_events,
    record,
    write_events,
)


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    flight = Keyframes({0: look_at((-2, -0.5, 0.6), (0, 0, 0)), 0.3: look_at((-2, 0.5, 0.6), (0, 0, 0))})
    scene = Scene(Camera(120, 90, pose=flight), duration=0.1) + Primitive(
        "sphere", material=Material(procedural="checks")
    )
    write_events(out / "events.h5", record(scene, labels=[]).events, 90, 120)
    for ending in (".raw", ".csv", ".npz"):
        count = convert(out / "events.h5", out / f"events{ending}", size=(90, 120))
        with open_events(out / f"events{ending}") as file:
            print(
                f"{file.path.name:10} {file.format:5} {count} events, {file.path.stat().st_size / count:5.1f} bytes "
                "each"
            )


def test_final(out: Path) -> None:
    first = read_events(out / "events.h5")
    for ending in (".raw", ".csv", ".npz"):
        other = read_events(out / f"events{ending}")
        for column in "xytp":
            assert np.array_equal(getattr(first, column), getattr(other, column)), (ending, column)


if __name__ == "__main__":
    main(Path("out/examples/convert_formats"))
