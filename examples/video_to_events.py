"""Any video to events: a video is made on the spot, then turned into an event file as a DAVIS346 would have seen it."""

from pathlib import Path

import imageio.v2 as imageio
import numpy as np

from blinkgl import open_events, simulate_file


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    y, x = np.mgrid[:96, :128]
    with imageio.get_writer(out / "disc.mp4", fps=50, macro_block_size=None) as video:
        for k in range(12):  # a bright disc crosses a dim gradient
            disc = np.hypot(x - 20 - 8 * k, y - 48) < 14
            video.append_data(np.repeat(np.where(disc, 220, 40 + x // 2).astype(np.uint8)[..., None], 3, axis=2))

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
