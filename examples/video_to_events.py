"""Video to events, with the sensor file of a DAVIS346."""

from pathlib import Path

import av
import numpy as np

from blinkgl import open_events, simulate_file


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    y, x = np.mgrid[:96, :128]
    with av.open(out / "disc.mp4", "w") as video:
        stream = video.add_stream("libx264", rate=50, width=128, height=96, pix_fmt="yuv420p")
        for k in range(12):  # a bright disc crosses a dim gradient
            disc = np.hypot(x - 20 - 8 * k, y - 48) < 14
            frame = np.where(disc, 220, 40 + x // 2).astype(np.uint8)
            video.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "gray").reformat(format="yuv420p")))
        video.mux(stream.encode())

    report = simulate_file(
        out / "disc.mp4",
        out / "events.h5",
        sensor="davis346",
        emulator="v2e",
        interpolate="motion",
        preview=out / "events.mp4",
    )
    print(
        f"{report.frames} frames, {report.steps} steps with those in between, {report.events} events, "
        f"{100 * report.on / report.events:.0f} % ON"
    )


def test_final(out: Path) -> None:
    with open_events(out / "events.h5") as file:
        events = file.read()
    assert len(events) > 1000 and 0.2 < events.p.mean() < 0.8
    on = events.p == 1
    early, late = (np.median(events.x[on & mask]) for mask in (events.t < 60_000, events.t > 160_000))
    assert late > early + 40, "the ON edge moves with the disc"
    assert (out / "events.mp4").stat().st_size > 1000


if __name__ == "__main__":
    main(Path("out/examples/video_to_events"))
