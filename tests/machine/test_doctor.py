"""``blinkgl doctor`` tells the truth: what works here, and what a broken machine lacks."""

from __future__ import annotations

import configparser
import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from blinkgl import cli
from blinkgl.gl import context as context_module
from blinkgl.machine import extras
from blinkgl.show import doctor as doctor


@pytest.fixture(scope="module")
def report():
    return doctor.examine()


def by_name(report) -> dict[str, doctor.Check]:
    return {f"{check.section}/{check.name}": check for check in report.checks}


def test_this_machine_passes_every_required_check(report):
    assert report.ok, [check for check in report.checks if check.status == "missing"]
    checks = by_name(report)
    for name in (
        "OpenGL/context",
        "OpenGL/32F depth, reversed-Z",
        "OpenGL/R32F target",
        "OpenGL/RG32F target",
        "OpenGL/RGBA32F target",
        "Kernels/numba",
        "Kernels/kernels",
        "Codecs/HDF5 blosc-zstd",
        "Codecs/libx264 video",
        "Codecs/16-bit RGB PNG",
    ):
        assert checks[name].status == "ok", checks[name]


def test_no_opengl_is_reported_with_the_remedy_and_status_2(monkeypatch, capsys):
    monkeypatch.setattr(context_module, "_EGL_LIBRARIES", ("libmissing.so",))
    monkeypatch.setattr(context_module, "LIBRARIES", ("libmissing.so",))
    monkeypatch.setattr(doctor, "_numba", lambda: iter(()))  # compiled in another test; slow
    assert cli.run(["doctor", "--json"]) == 2
    result = json.loads(capsys.readouterr().out)
    context = next(check for check in result["checks"] if check["name"] == "context")
    assert not result["ok"] and context["status"] == "missing"
    assert "apt-get install" in context["remedy"] and "libegl1" in context["remedy"]
    assert cli.run(["doctor"]) == 2
    shown = capsys.readouterr().out
    assert "MISSING" in shown and "Something required is missing" in shown and "sudo apt-get install" in shown


def test_a_codec_that_lies_is_found(monkeypatch):
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr(cv2, "imdecode", lambda data, flags: data.astype("uint16"))
    check = next(check for check in doctor._codecs() if check.name == "16-bit RGB PNG")
    assert check.status == "missing" and "opencv-python-headless" in check.remedy


def test_a_target_that_rounds_is_found(gl, monkeypatch):
    from blinkgl.gl import framebuffer

    half = framebuffer.FORMATS["RGBA16F"]._replace(gl="f2")
    monkeypatch.setitem(framebuffer.FORMATS, "RGBA32F", half)
    with pytest.raises(ValueError, match="drew"):
        doctor._draw_exactly(gl, "RGBA32F")


def test_clip_space_that_is_not_zero_to_one_is_found(gl):
    import ctypes

    clip_control = gl.function("glClipControl", None, ctypes.c_uint, ctypes.c_uint)
    clip_control(0x8CA1, 0x935E)  # GL_NEGATIVE_ONE_TO_ONE
    try:
        with pytest.raises(ValueError):
            doctor._draw_depth(gl)
    finally:
        clip_control(0x8CA1, 0x935F)


def test_an_extra_names_what_lacks_and_installs_it(monkeypatch):
    monkeypatch.setattr(doctor, "EXTRAS", {"one": (("numpy", "no-such-thing"), "tests")})
    (check,) = doctor._extras()
    assert check.status == "absent" and check.value.startswith(f"numpy {np.__version__}, no no-such-thing (tests)")
    assert check.remedy.endswith("-m pip install no-such-thing")


def test_libraries_that_are_newer_than_tested_are_named(monkeypatch):
    here = {"av": "19.0.2", "numpy": "1.26.4", "unknown": "9", "torch": f"{extras.TESTED['torch']}+cpu"}
    monkeypatch.setattr(extras, "distributions", lambda: [SimpleNamespace(name=k, version=v) for k, v in here.items()])
    assert extras.newer_than_tested() == [f"av 19.0.2 (tested: {extras.TESTED['av']})"]
    (check,) = [check for check in doctor._system() if check.name == "libraries"]
    assert check.value.startswith("newer than tested: av 19.0.2") and check.status == "info"


def test_tested_versions_are_those_of_the_constraints():
    root = Path(__file__).parents[2]
    pinned = dict(re.findall(r"^([\w-]+)==([^\s;]+)", (root / "constraints.txt").read_text().lower(), re.M))
    assert {name.lower(): version for name, version in extras.TESTED.items()}.items() <= pinned.items()
    setup = configparser.ConfigParser()
    setup.read(root / "setup.cfg")
    needed = re.findall(r"^([\w-]+)", setup["options"]["install_requires"].strip(), re.M)
    assert set(needed) <= extras.TESTED.keys()
