"""The files that rows name: a scene file, a rigged one, and two folders of frames with their flow."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "scene"))

from features import HEIGHT, WIDTH
from gltf_files import GltfBuilder, arm_file

FRAMES, SHIFT = 5, (1.25, -0.5)


@pytest.fixture(scope="session")
def assets(tmp_path_factory) -> Path:
    """Folder that relative paths of the rows start from."""
    folder = tmp_path_factory.mktemp("assets")
    scene_file(folder / "scene.glb")
    (folder / "arm.glb").write_bytes(arm_file(morphs=True).glb())
    for number in range(2):
        frame_folder(folder / f"P{number:03d}", number)
    return folder


def scene_file(path: Path) -> None:
    """Coloured triangles, glTF's y up, before a camera at x = -3 that looks along +x."""
    builder, rng = GltfBuilder(), np.random.default_rng(0)
    for n in range(6):
        colour = [*rng.uniform(0, 1, 3), 1]
        builder.tree.setdefault("materials", []).append(
            {"pbrMetallicRoughness": {"baseColorFactor": colour, "metallicFactor": 0}, "doubleSided": True}
        )
        corners = rng.uniform(-1, 1, (3, 3)) * [0.3, 1, 1] + [0, rng.uniform(-1, 1), rng.uniform(-1, 1)]
        builder.node(mesh=builder.mesh(corners, [[0, 1, 2]], material=n))
    path.write_bytes(builder.glb())


def frame_folder(folder: Path, seed: int) -> None:
    """A texture that slides by SHIFT px a frame; flow as .npy with masks, and once more as .flo."""
    from blinkgl.io.flow import encode_flo

    for name in ("image_left", "flow", "flow_flo"):
        (folder / name).mkdir(parents=True)
    texture = cv2.GaussianBlur(
        np.random.default_rng(seed).random((4 * HEIGHT, 4 * WIDTH)).astype(np.float32), (0, 0), 1.5
    )
    texture = (texture - texture.min()) / np.ptp(texture)
    for k in range(FRAMES):
        move = np.float32([[1, 0, k * SHIFT[0] - WIDTH], [0, 1, k * SHIFT[1] - HEIGHT]])
        image = cv2.warpAffine(texture, move, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
        cv2.imwrite(
            str(folder / f"image_left/{k:06d}.png"), np.repeat((image * 255).astype(np.uint8)[..., None], 3, axis=2)
        )
    for k in range(FRAMES - 1):
        flow, valid = np.broadcast_to(np.float32(SHIFT), (HEIGHT, WIDTH, 2)), np.ones((HEIGHT, WIDTH), bool)
        np.save(folder / f"flow/{k:06d}.npy", flow)
        np.save(folder / f"flow/{k:06d}_mask.npy", np.eye(HEIGHT, WIDTH, dtype=np.uint8))
        (folder / f"flow_flo/{k:06d}.flo").write_bytes(encode_flo(flow, valid))
