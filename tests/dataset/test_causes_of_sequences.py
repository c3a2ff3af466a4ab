"""Causes of events in a data set: file, manifest, summary, report; `verify` sees them altered."""

from __future__ import annotations

import json

import h5py

from blinkgl.cli import run

CONFIG = """
camera: {width: 48, height: 36}
time: {duration: 0.05, label_rate: 100}
events: {emulator: v2e, causes: true, shot_noise_rate_hz: 100, leak_rate_hz: 50}
scene: {kind: random, pool: {primitives: [cuboid]}, textures: {photographs: false, max_size: 32}}
"""


def test_causes_from_the_run_to_the_report(tmp_path, capsys):
    (tmp_path / "c.yaml").write_text(CONFIG)
    out = tmp_path / "d"
    assert run(["generate", str(tmp_path / "c.yaml"), "--out", str(out)]) == 0
    assert "by cause" in capsys.readouterr().out
    path = next(out.rglob("manifest.json"))
    manifest = json.loads(path.read_text())
    counts = manifest["events_by_cause"]
    assert sum(counts.values()) == manifest["events"] and counts["hot"] == 0 < min(counts["leak"], counts["signal"])
    assert run(["verify", str(out)]) == 0 and run(["report", str(out)]) == 0
    assert "Hz/px</b><span>shot events" in next(out.glob("*.html")).read_text()

    with h5py.File(path.parent / "events.h5", "r+") as file:
        file["events/cause"][3] = (file["events/cause"][3] + 1) % 4
    assert run(["verify", str(out)]) != 0
