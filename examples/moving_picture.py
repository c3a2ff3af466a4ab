"""README's moving picture: frame, events, events in space and time, exact flow, what made each event, depth."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from blinkgl import Camera, Deform, Keyframes, Material, Pose, Primitive, Scene, Way, look_at, record

WIDTH, HEIGHT, RATE, CENTRE = 320, 240, 15, (3.4, 0, 0.95)


def scene(duration: float) -> Scene:
    """People who dance and walk, a fish, a flag and a tower that bends, seen by a camera that flies around them."""
    places = np.linspace(-0.5, 0.5, 9)
    flight = {
        (k + 0.0) / 8 * (duration + 0.2): look_at((-0.2 + 0.5 * s**2, 1.4 * s, 1.5), CENTRE)
        for k, s in enumerate(places)
    }
    made = Scene(Camera(WIDTH, HEIGHT, fov=58, pose=Keyframes(flight)), duration=duration, label_rate=RATE)
    brick = Material(photograph="brick", uv_scale=(8, 8))
    made += Primitive("grid", width=24, depth=24, material=brick, category="ground")
    made += Primitive("figure", clip="dance", variant=3, coat=2, pose=Pose((3, -0.8, 0), euler=(0, 0, 160)))
    made += Primitive("figure", clip="walk", coat=5, pose=Way([(4, 0.9, 0), (4.2, -0.4, 0), (4, -4, 0)]))
    made += Primitive("figure", clip="dance", variant=8, coat=7, pose=Pose((4.6, 1.5, 0), euler=(0, 0, 190)))
    made += Primitive(
        "fish", length=0.5, coat=1, pose=Way([(2.4, -0.4, 1.8), (2.4, 0.6, 1.9), (2.8, 2, 2)], level=False)
    )
    made += Primitive("flag", wind=1.5, coat=4, pose=Pose((5, 2.6, 1.5), euler=(0, 0, -80)))
    tower = Material(procedural="bricks", uv_scale=(2, 3))
    bends = Deform("bend", angle=25, period=0.8)
    return made + Primitive("cuboid", extents=(0.4, 0.4, 1.4), material=tower, pose=(2.9, 0.95, 0.7), deform=bends)


def flow_picture(flow: np.ndarray, largest: float, valid: np.ndarray | bool = True) -> np.ndarray:
    """Hue is direction, saturation is speed; white does not move."""
    angle, speed = np.arctan2(flow[..., 1], flow[..., 0]), np.linalg.norm(flow, axis=-1)
    hsv = np.stack([(np.degrees(angle) % 360) / 2, 255 * np.minimum(speed / largest, 1), np.full_like(angle, 255)], -1)
    return np.where(np.asarray(valid)[..., None], cv2.cvtColor(hsv.astype(np.uint8), cv2.COLOR_HSV2RGB), 60)


def events_picture(events) -> np.ndarray:
    """Blue where it became brighter, red where darker, over white."""
    sums = np.zeros((HEIGHT, WIDTH), np.float32)
    np.add.at(sums, (events.y, events.x), 2.0 * events.p - 1)
    level = np.minimum(np.abs(sums) / 3, 1)[..., None]
    colour = np.where(sums[..., None] > 0, (40, 90, 220), (225, 60, 50))
    return (255 + level * (colour - 255)).astype(np.uint8)


def space_time_picture(events, start_us: int, span_us: int) -> np.ndarray:
    """Events as points in x, y and time, seen from the side; the newest in front."""
    x, y, age = events.x - WIDTH / 2, events.y - HEIGHT / 2, 1 - (events.t - start_us) / span_us
    u = (WIDTH * 0.36 + 0.62 * x + 150 * age).astype(int)
    v = (HEIGHT * 0.56 + 0.62 * y - 60 * age).astype(int)
    canvas = np.full((HEIGHT, WIDTH, 3), 18, np.uint8)
    order = np.argsort(events.t)
    order = order[(u[order] >= 0) & (u[order] < WIDTH) & (v[order] >= 0) & (v[order] < HEIGHT)]
    colour = np.where(events.p[order, None] > 0, (110, 160, 255), (255, 110, 90)) * (1 - 0.65 * age[order, None])
    canvas[v[order], u[order]] = colour.astype(np.uint8)
    return canvas


def origin_picture(events) -> np.ndarray:
    """Each event in the colour of the body that it belongs to."""
    hue = (events.truth["instance"].astype(np.int64) * 47 % 180).astype(np.uint8)
    colour = cv2.cvtColor(np.stack([hue, np.full_like(hue, 200), np.full_like(hue, 215)], -1)[None], cv2.COLOR_HSV2RGB)
    canvas = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    canvas[events.y, events.x] = colour[0]
    return canvas


def depth_picture(depth: np.ndarray) -> np.ndarray:
    """Near is yellow, far is dark."""
    near = np.clip(1 - np.log(np.clip(depth, 1, 20)) / np.log(20), 0, 1)
    return cv2.applyColorMap((255 * near).astype(np.uint8), cv2.COLORMAP_INFERNO)[..., ::-1]


def main(out: Path, duration: float = 0.2, shrink: float = 0.75) -> None:
    out.mkdir(parents=True, exist_ok=True)
    recording = record(scene(duration), labels=("images", "forward", "depth", "events"))
    t, events = recording.t_us, recording.events
    ground = 1  # bodies are numbered in their order
    bodies = events.part(events.truth["instance"] > ground)
    longest = np.percentile(np.linalg.norm(recording.flow, axis=-1)[recording.valid], 95)
    pictures = []
    for k, label in enumerate(recording.labels[:-1]):
        new = events.window(t[k], t[k + 1])
        trail_us = 400_000
        panels = {
            "frame": recording.images[k],
            "events until the next frame": events_picture(new),
            "events of the bodies in x, y and time": space_time_picture(
                bodies.window(t[k + 1] - trail_us, t[k + 1]), t[k + 1] - trail_us, trail_us
            ),
            "exact optical flow": flow_picture(recording.flow[k], longest, recording.valid[k]),
            "what made each event": origin_picture(new),
            "depth": depth_picture(label.depth),
        }
        rows = [np.hstack([titled(*panel, shrink) for panel in list(panels.items())[i : i + 3]]) for i in (0, 3)]
        pictures.append(Image.fromarray(np.vstack(rows)))
    pictures[0].save(
        out / "moving.webp",
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 / RATE),
        loop=0,
        quality=55,
        method=6,
    )
    share = len(bodies) / len(events)
    print(f"{len(pictures)} pictures of {len(events) / 1e6:.1f} M events, {100 * share:.0f} % of them of moving bodies")


def titled(title: str, picture: np.ndarray, shrink: float) -> np.ndarray:
    """The picture, smaller, with its name above it and a gap around it."""
    small = cv2.resize(picture.astype(np.uint8), None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    framed = cv2.copyMakeBorder(small, 20, 2, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    return cv2.putText(framed, title, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (40, 40, 40), 1, cv2.LINE_AA)


def test_final(out: Path) -> None:
    with Image.open(out / "moving.webp") as moving:
        assert moving.n_frames >= 1 and moving.size == (3 * 244, 2 * 202)
        assert np.asarray(moving.convert("RGB")).std() > 40


if __name__ == "__main__":
    main(Path("out/examples/moving_picture"), duration=1.6)
