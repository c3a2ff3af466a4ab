"""What is generated stays as it is, byte for byte, until a commit says why it changes (tools/fingerprint.py)."""

import subprocess
import sys

import pytest

from blinkgl.tools import fingerprint


def test_the_bytes_of_all_cases():
    known = fingerprint.kept(fingerprint.platform_name())
    if not known:
        pytest.skip("no sums are kept for this rasteriser and NumPy: python -m blinkgl.tools.fingerprint --keep")
    pytest.importorskip("mujoco")
    command = [sys.executable, "-m", "blinkgl.tools.fingerprint"]  # its own process: see PINNED
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, (
        "\n".join(line for line in ran.stdout.splitlines() if "folders" not in line) + ran.stderr
    )
    assert ran.stdout.count(" folders\n") == len(fingerprint.names())


def test_sums_of_another_vendor_are_dropped_when_pictures_change():
    before = {"a/images": {"AMD": "1", "Intel": "2"}, "a": "3"}
    assert fingerprint.differences(before, {"a/images": "2", "a": "3"}, "Intel") == []
    assert fingerprint.differences(before, {"a/images": "9", "a": "3"}, "Other") == []  # nothing is kept of it
    assert fingerprint.differences(before, {"a/images": "1", "b": "3"}, "Intel") == ["a", "a/images", "b"]
    assert fingerprint.renewed(before, {"a/images": "2", "a": "4"}, "Intel") == {**before, "a": "4"}
    assert fingerprint.renewed(before, {"a/images": "5", "a": "3"}, "Intel") == {"a/images": {"Intel": "5"}, "a": "3"}


def test_every_kept_sum_belongs_to_a_case():
    for file in (fingerprint.HERE / "sums").glob("*.json"):
        assert fingerprint.kept(file.stem).keys() <= set(fingerprint.names()), file.name
