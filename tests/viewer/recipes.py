"""Small sequences in which there is everything that can be shown."""

_SCENE = {
    "kind": "random",
    "objects": {"count": 3, "distance": [2, 4], "size": [0.6, 1.2]},
    "pool": {"primitives": ["cuboid"], "variants": 4},
    "textures": {"procedural": ["checks", "fbm"], "variants": 4, "photographs": False, "max_size": 64},
}
SINGLE = {
    "seed": 5,
    "camera": {"width": 48, "height": 36},
    "time": {"duration": 0.2, "label_rate": 10, "start": 7.0},
    "timeline": {"kind": "uniform", "fps": 60},
    "scene": _SCENE,
    "labels": {
        "flow": ["forward", "backward"],
        **dict.fromkeys(
            ("images", "occlusion", "depth", "ids", "boxes", "normals", "semantics", "velocity", "scene_flow"), True
        ),
    },
    "tracks": {"points": 20, "choose": "surface", "rate": 20},
    "imu": {"preset": "ideal", "rate": 100},
    "images": {"rate": 20},
    "preview": {"enabled": False},
}
RIG = {
    "seed": 5,
    "rig": "stereo",
    "camera": {"width": 40, "height": 30},
    "time": {"duration": 0.1, "label_rate": 10},
    "timeline": {"kind": "uniform", "fps": 60},
    "scene": _SCENE,
    "labels": {"flow": ["forward"], "depth": True, "disparity": True, "occlusion": False},
    "sensors": [
        {"name": "rgb", "camera": {"width": 48, "height": 32}, "images": {"rate": 20}},
        {"name": "imu", "imu": {"preset": "ideal", "rate": 100}},
    ],
    "preview": {"enabled": False},
}
