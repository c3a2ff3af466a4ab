"""blinkgl explain: what it says is what a run does."""

import yaml

from blinkgl.config.sequence import load_run
from blinkgl.dataset.generate import generate_run
from blinkgl.explain import explain

SMALL = {
    "camera": {"width": 64, "height": 48}, "time": {"duration": 0.2, "label_rate": 20},
    "timeline": {"kind": "displacement", "max_px": 0.5},
    "scene": {"kind": "random", "objects": {"count": 4}, "textures": {"photographs": False, "max_size": 64, "variants": 2},
              "pool": {"primitives": ["cuboid"], "variants": 2}},
    "labels": {"flow": ["forward"]}, "preview": {"enabled": False},
}


def template(tmp_path, **changes):
    path = tmp_path / "run.yaml"
    path.write_text(yaml.safe_dump({**SMALL, **changes}))
    return load_run(path)


def test_expected_frames_and_passes_are_those_of_the_run(tmp_path):
    run = template(tmp_path)
    told = explain(run)
    made = list(generate_run(run, tmp_path / "out"))[0]
    assert abs(told.frames - made.frames) < 0.25 * made.frames
    assert [p.name for p in told.passes] == ["event frames", "velocity", "colour", "labels", "event kernel"]
    assert f"{made.triangles:,}" == told.scene["triangles"] and "4 objects" in told.scene["bodies"]
    assert all(p.seconds > 0 and p.count > 0 for p in told.passes)


def test_what_is_left_out_follows_the_configuration(tmp_path):
    out = dict(explain(template(tmp_path)).left_out)
    assert "depth" in out and "backward flow" in out and "preview" in out and "esim: refractory_us" in out
    more = explain(template(tmp_path, timeline={"kind": "uniform", "fps": 100}, labels={"images": False, "depth": True, "flow": []},
                            events={"emulator": "esim", "refractory_us": 50}, render={"antialiasing": "ssaa2"}))
    out = dict(more.left_out)
    assert "depth" not in out and "images" in out and "velocity pass" in out and "esim: refractory_us" not in out
    assert "anti-aliasing of event frames" not in out
    assert [p.name for p in more.passes] == ["event frames", "labels", "event kernel"]
    assert more.frames == 26, "0.25 s at 100 frames/s, both ends included"


def test_an_unlit_world_needs_no_normals(tmp_path):
    scene = {**SMALL["scene"], "light": {"unlit": True}}
    told = explain(template(tmp_path, scene=scene))
    assert "light" in dict(told.left_out)
    assert not any("LIT" in v.split("+") for p in told.passes for v in p.variants)


def test_passes_of_the_other_timelines(tmp_path):
    result = explain(template(tmp_path, timeline={"kind": "brightness", "reconstruction": "hermite", "max_fraction_of_threshold": 2.0}))
    passes = {p.name: p for p in result.passes}
    assert {"event frames with rates", "brightness"} <= set(passes) and "velocity" not in passes
    assert any("RATE" in v for v in passes["event frames with rates"].variants)
    assert "hermite in between" in passes["event frames with rates"].why
    budget = explain(template(tmp_path, timeline={"kind": "budget", "max_time_error_us": 500}))
    assert {"event frames", "velocity"} <= {p.name for p in budget.passes} and budget.frames > 2
    assert ("rates of change in the event frames", "timeline.reconstruction: linear") in budget.left_out
