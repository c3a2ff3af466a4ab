"""What is generated stays as it is, byte for byte, until a commit says why it changes (tools/fingerprint.py)."""

import functools

import pytest

from blinkgl.tools import fingerprint


@functools.cache
def kept():
    platform = fingerprint.platform_name()
    return platform, fingerprint.kept(platform)


@pytest.mark.parametrize("name", fingerprint.names())
def test_the_bytes_of(name):
    platform, sums = kept()
    if sums is None:
        pytest.skip(f"no sums are kept for {platform}: python -m blinkgl.tools.fingerprint --keep")
    if name not in sums:
        pytest.skip(f"no sum of this case is kept for {platform}: python -m blinkgl.tools.fingerprint --keep")
    if name == "falls":
        pytest.importorskip("mujoco")
    assert not fingerprint.differences(name, sums[name], fingerprint.fingerprint(name))


def test_every_kept_sum_belongs_to_a_case():
    for file in (fingerprint.HERE / "sums").glob("*.json"):
        assert fingerprint.kept(file.stem).keys() <= set(fingerprint.names()), file.name
