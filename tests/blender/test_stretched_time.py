"""The time of a scene that is baked with several key frames per frame, by a stand-in of Blender's module."""

from __future__ import annotations

import sys
from importlib import resources
from types import ModuleType, SimpleNamespace

import pytest

NAMES = ("bpy", "mathutils", "baking", "exporting", "glb", "rates")


@pytest.fixture
def inside(monkeypatch):
    """``exporting`` and the scene S that is shown, of 24 frames per second, beside a scene T; frame numbers gone to."""
    markers = [SimpleNamespace(frame=frame, camera=SimpleNamespace(name=name)) for frame, name in ((1, "A"), (5, "B"))]
    scenes = {}
    for name in "ST":
        render = SimpleNamespace(fps=24, fps_base=1.0, frame_map_old=100, frame_map_new=100)
        render.pixel_aspect_x = render.pixel_aspect_y = 1
        scenes[name] = SimpleNamespace(
            name=name, frame_current=7, frame_start=1, frame_end=10, objects=[], rigidbody_world=None, render=render,
            timeline_markers=markers, went=[], world=None, camera=None, unit_settings=SimpleNamespace(scale_length=1),
        )  # fmt: skip
        scenes[name].frame_set = lambda frame, subframe=0.0, scene=scenes[name]: scene.went.append(frame + subframe)
    bpy, mathutils = ModuleType("bpy"), ModuleType("mathutils")
    mathutils.Matrix = lambda *rows: SimpleNamespace(transposed=lambda: None)
    bpy.context = SimpleNamespace(scene=scenes["S"], evaluated_depsgraph_get=lambda: None)
    bpy.context.preferences = SimpleNamespace(filepaths=SimpleNamespace(use_scripts_auto_execute=False))
    nothing = lambda **options: None
    bpy.ops = SimpleNamespace(wm=SimpleNamespace(read_factory_settings=nothing, open_mainfile=nothing))
    bpy.data = SimpleNamespace(version=(4, 5, 0), scenes=scenes, node_groups=[], images=[], libraries=[], actions=[])
    bpy.app = SimpleNamespace(version=(4, 5, 0))

    class Window:
        scene = property(lambda self: bpy.context.scene, lambda self, scene: setattr(bpy.context, "scene", scene))

    bpy.context.window = Window()
    for name in NAMES:
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    monkeypatch.setitem(sys.modules, "mathutils", mathutils)
    monkeypatch.syspath_prepend(str(resources.files("blinkgl.blender") / "inside"))
    import exporting

    yield exporting, scenes
    for name in NAMES:
        sys.modules.pop(name, None)


@pytest.mark.parametrize(("per", "ratio"), [(1, (1, 1)), (4, (1, 4)), (16, (1, 16)), (64, (1, 64))])
def test_the_ratio_of_the_stretched_time_fits_into_blenders_numbers(inside, per, ratio):
    """Blender takes at most 900, and anything above as 900."""
    exporting, scenes = inside
    clock = exporting.clock_of([1, 10], per)
    render = scenes["S"].render
    assert (render.frame_map_old, render.frame_map_new) == ratio
    clock.go(clock.here)
    assert scenes["S"].went[-1] == 7 * per


def test_what_blender_cannot_count_is_refused(inside):
    exporting, scenes = inside
    scenes["S"].render.frame_map_old = 101
    with pytest.raises(exporting.Refused, match="10 key frames per frame of this scene are more than Blender counts"):
        exporting.clock_of([1, 10], 10)
    assert exporting.clock_of([1, 10], 8).per == 8  # the remedy, a smaller number
    scenes["S"].render.frame_map_old = 100
    with pytest.raises(exporting.Refused, match="more than Blender counts"):
        exporting.clock_of([300_000, 300_100], 4)


@pytest.mark.parametrize(
    ("old", "new", "last", "finest"),
    [(100, 100, 10, 512), (101, 113, 10, 4), (897, 899, 10, 1), (100, 100, 300_000, 2)],
)
def test_no_more_key_frames_are_added_than_blender_counts(inside, old, new, last, finest):
    """Of a scene's own time map and last frame; whoever asked for one per frame is not told to ask for fewer."""
    exporting, scenes = inside
    scenes["S"].render.frame_map_old, scenes["S"].render.frame_map_new = old, new
    clock = exporting.clock_of([last - 9, last], 1)
    assert clock.finest() == finest
    clock.stretch(clock.finest())


def test_cuts_between_cameras_have_the_files_own_frames(inside):
    exporting, _ = inside
    lines = exporting.left_out([], exporting.clock_of([1, 10], 4))
    assert any("'A' from frame 1, 'B' from frame 5" in line for line in lines)


def test_frames_per_second_are_of_the_scene_that_is_chosen(inside, monkeypatch, tmp_path):
    exporting, scenes = inside
    monkeypatch.setattr(exporting, "rendered", lambda: (_ for _ in ()).throw(InterruptedError))
    with pytest.raises(InterruptedError):
        exporting.run({"source": "a.blend", "fps": 60.0, "scene": "T"}, tmp_path / "a.glb", lambda **said: None)
    assert scenes["T"].render.fps / scenes["T"].render.fps_base == 60
