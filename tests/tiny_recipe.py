"""A recipe whose sequences take milliseconds."""

TINY = {
    "seed": 3,
    "camera": {"width": 32, "height": 32},
    "time": {"duration": 0.05, "label_rate": 20},
    "timeline": {"kind": "displacement", "max_px": 2.0},
    "scene": {
        "objects": {"count": 2},
        "textures": {"photographs": False, "procedural": ["checks"], "variants": 2, "max_size": 32},
        "pool": {"primitives": ["cuboid"], "variants": 2, "test_fraction": 0.5},
        "object_motion": {"kind": "static"},
        "camera_motion": {"speed": 2, "rotation_rate": 90},
    },
    "labels": {"images": False, "flow": ["forward"], "occlusion": False},
    "preview": {"enabled": False},
}
