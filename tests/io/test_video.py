"""Videos, the preview, and colours."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from PIL import ImageFont

from blinkgl.errors import AssetError, OutputError
from blinkgl.io.video import VideoReader, VideoWriter
from blinkgl.sequence_files.preview import Panels, PreviewWriter
from blinkgl.types.events import Events


def write_video(path, count=12, height=48, width=64):
    y, x = np.mgrid[:height, :width]
    frames = [np.dstack([x * 3, y * 4, np.full_like(x, 20 * i)]).astype(np.uint8) for i in range(count)]
    with VideoWriter(path, height, width, 25) as video:
        for frame in frames:
            video.write(frame)
    return frames


@pytest.mark.parametrize("ending", ["mp4", "mkv", "avi"])
def test_video_round_trip_and_independent_decoder(tmp_path, ending):
    frames = write_video(tmp_path / f"v.{ending}")
    reader = VideoReader(tmp_path / f"v.{ending}")
    assert (reader.height, reader.width, reader.fps) == (48, 64, 25)
    decoded = [frame for frame, _ in reader]
    assert len(decoded) == 12
    assert max(np.abs(a.astype(int) - b).mean() for a, b in zip(frames, decoded)) < 6  # lossy, subsampled chroma
    capture = cv2.VideoCapture(str(tmp_path / f"v.{ending}"))
    assert np.abs(capture.read()[1][..., ::-1].astype(int) - frames[0]).mean() < 6


@pytest.mark.parametrize("ending", ["mp4", "mkv", "avi"])
def test_truncated_video_is_an_error_that_names_the_frame(tmp_path, ending):
    path = tmp_path / f"v.{ending}"
    rng = np.random.default_rng(0)
    with VideoWriter(path, 96, 128, 25) as video:
        for _ in range(30):
            video.write(rng.integers(0, 255, (96, 128, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    count = 0
    with pytest.raises(AssetError, match=f"v.{ending}: video truncated or corrupt after frame [0-9]+") as caught:
        for _ in VideoReader(path):
            count += 1
    assert f"after frame {count}" in str(caught.value) and 5 < count < 25


@pytest.mark.parametrize(
    "content, message",
    [
        (b"", "cannot read video"),
        (b"not a video at all" * 100, "cannot read video: .*[Ii]nvalid data"),
        (None, "no such file"),
    ],
)
def test_unreadable_video(tmp_path, content, message):
    if content is not None:
        (tmp_path / "v.mp4").write_bytes(content)
    with pytest.raises(AssetError, match=message) as caught:
        VideoReader(tmp_path / "v.mp4")
    assert "\n" not in str(caught.value)


_DASH = (
    '<MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static" mediaPresentationDuration="PT1S" '
    'profiles="urn:mpeg:dash:profile:isoff-on-demand:2011"><Period><AdaptationSet mimeType="video/mp4">'
    '<Representation id="1" bandwidth="1" width="64" height="48" codecs="avc1.42c00d">'
    "<BaseURL>{other}</BaseURL></Representation></AdaptationSet></Period></MPD>"
)


@pytest.mark.parametrize(
    "content",
    [
        "ffconcat version 1.0\nfile other.mp4\n",
        _DASH,
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:0.5,\nother.mp4\n#EXT-X-ENDLIST\n",
    ],
    ids=["concat", "DASH", "HLS"],
)
@pytest.mark.parametrize("name", ["v.mp4", "v.m3u8", "v.mpd"])
def test_a_video_leads_to_no_other_file(tmp_path, name, content):
    write_video(tmp_path / "other.mp4")
    (tmp_path / name).write_text(content.replace("{other}", str(tmp_path / "other.mp4")))
    with pytest.raises(AssetError, match=f"{name}: cannot read video.*(a video by itself|[Ii]nvalid data)"):
        list(VideoReader(tmp_path / name))


def turned(data: bytes, a: int, b: int, c: int, d: int) -> bytes:
    """An MP4 with another matrix in its track header (ISO 14496-12, 8.3.2): x' = a x + c y, y' = b x + d y."""
    at = data.index(b"tkhd") + 4 + 4 + 20 + 16
    fixed = lambda value: (value << 16).to_bytes(4, "big", signed=True)
    matrix = [fixed(a), fixed(b), bytes(4), fixed(c), fixed(d), bytes(4), bytes(8), (1 << 30).to_bytes(4, "big")]
    return data[:at] + b"".join(matrix) + data[at + 36 :]


@pytest.mark.parametrize(("matrix", "upright"), [
    ((-1, 0, 0, 1), lambda image: image[:, ::-1]), ((1, 0, 0, -1), lambda image: image[::-1]),
    ((0, 1, 1, 0), lambda image: image.swapaxes(0, 1)),
    ((0, -1, -1, 0), lambda image: image[::-1, ::-1].swapaxes(0, 1)),
])  # fmt: skip
def test_mirrored_video_comes_as_it_is_seen(tmp_path, matrix, upright):
    write_video(tmp_path / "v.mp4")
    (tmp_path / "m.mp4").write_bytes(turned((tmp_path / "v.mp4").read_bytes(), *matrix))
    frame, expected = (next(iter(VideoReader(tmp_path / name)))[0] for name in ("m.mp4", "v.mp4"))
    assert np.array_equal(frame, upright(expected))


@pytest.mark.parametrize("degrees, shape", [(0, (48, 64)), (90, (64, 48)), (180, (48, 64)), (270, (64, 48))])
def test_rotated_video_comes_upright(tmp_path, degrees, shape):
    write_video(tmp_path / "v.mp4")
    data = (tmp_path / "v.mp4").read_bytes()
    a, b = {0: (1, 0), 90: (0, -1), 180: (-1, 0), 270: (0, 1)}[degrees]
    (tmp_path / "r.mp4").write_bytes(turned(data, a, b, -b, a))
    reader = VideoReader(tmp_path / "r.mp4")
    upright = np.rot90(next(iter(VideoReader(tmp_path / "v.mp4")))[0], degrees // 90)
    frame, _ = next(iter(reader))
    assert (reader.height, reader.width) == shape == frame.shape[:2] == upright.shape[:2]
    assert np.abs(frame.astype(int) - upright).mean() < 6


def test_video_without_pictures(tmp_path):
    with pytest.raises(OutputError, match="cannot write video"):
        write_video(tmp_path / "none" / "v.mp4")
    with pytest.raises(OutputError, match="cannot write video"):
        write_video(tmp_path / "v.unknown_ending")
    with pytest.raises(ValueError, match="even sizes"):
        VideoWriter(tmp_path / "v.mp4", 47, 64, 25)


def test_no_ffmpeg(tmp_path, monkeypatch):
    monkeypatch.setattr("blinkgl.io.video._imported", lambda: (_ for _ in ()).throw(ImportError("no av")))
    with pytest.raises(OutputError, match="no FFmpeg for video; run .*pip install av"):
        VideoWriter(tmp_path / "v.mp4", 48, 64, 25)


@pytest.mark.parametrize("height, width", [(48, 65), (261, 347)])
@pytest.mark.parametrize("flow", [True, False])
def test_preview(tmp_path, height, width, flow):
    rng = np.random.default_rng(0)
    panels = Panels(height, width, t0_us=5000, flow=flow, rate_hz=100, fps=20)
    with PreviewWriter(tmp_path / "p.mp4", [panels], 20) as preview:
        for i in range(11):
            t = 5000 + i * 5000  # twice the preview's rate: every second frame is due
            n = 100
            panels.add_events(
                Events(
                    rng.integers(0, width, n).astype(np.uint16),
                    rng.integers(0, height, n).astype(np.uint16),
                    np.full(n, t, np.int64),
                    rng.integers(0, 2, n).astype(np.uint8),
                )
            )
            assert panels.due(t) == (i % 2 == 0)
            if i % 4 == 0:
                panels.set_flow(rng.normal(size=(height, width, 2)).astype(np.float32))
            preview.frame(t, rng.random((height, width) if i % 4 else (height, width, 3), dtype=np.float32))
    reader = VideoReader(tmp_path / "p.mp4")
    assert len(list(reader)) == 6 and reader.fps == 20
    assert reader.width > (2.5 if flow else 1.5) * width


def test_a_dense_picture_has_the_newest_events_and_says_so():
    panels = Panels(300, 400, flow=False, rate_hz=20, fps=20)
    most = round(0.35 * 300 * 400)
    for k in range(10):  # each chunk fills rows of its own
        y, x = np.divmod(np.arange(30 * 400), 400)
        polarity = np.full(len(x), k % 2, np.uint8)
        panels.add_events(Events(x.astype(np.uint16), (y + 30 * k).astype(np.uint16), np.full(len(x), k), polarity))
    panels.compose(0, np.zeros((300, 400), np.float32))
    events = panels.canvas[30:, 404:]
    rows = (events < 200).any(axis=-1).all(axis=1)
    assert not rows[: 300 - most // 400 - 1].any() and rows[300 - most // 400 :].all(), "the newest, and only those"
    assert {tuple(c) for c in np.unique(events.reshape(-1, 3), axis=0)} == {
        (255, 255, 255),
        (255, 104, 104),
        (104, 104, 255),
    }


@pytest.mark.parametrize("height, width", [(48, 64), (8, 8), (360, 202), (1920, 1080), (24, 500)])
def test_captions_do_not_run_into_each_other(height, width):
    panels = Panels(height, width, rate_hz=30, fps=15)
    panels.set_flow(np.ones((height, width, 2), np.float32))
    panels.compose(123_456_789, np.zeros((height, width), np.float32))
    panel = (panels.canvas.shape[1] - 8) // 3
    for k in range(3):
        strip = panels.canvas[:30, k * (panel + 4) : k * (panel + 4) + panel].max(axis=(0, 2))
        name = ["frame", "events", "optical flow"][k]
        start = int(8 + ImageFont.load_default(14).getlength(name)) + 1
        assert (strip[start : start + 6] < 40).all(), f"a gap behind {name}"
        assert (strip[:7] < 40).all() and (strip[-7:] < 40).all()
