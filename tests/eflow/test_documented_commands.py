"""Every command of docs/eflow.md runs as it is written there, on tiny data and with options that make it short."""

import importlib.util
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import yaml

torch = pytest.importorskip("torch")

from blinkgl import cli  # noqa: E402
from blinkgl.io.formats import write_events  # noqa: E402
from eflow.cli import run  # noqa: E402
from flow_data import SPAN, blinkgl_set, dsec_set, moving_events  # noqa: E402
from test_published import published  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
SHORT = "--set optim.steps=1 --set data.batch=1 --set data.workers=0 --set data.validate_on=[]"
NETWORK = f"{SHORT} --set model.width=4"
COMMANDS = {  # as documented: what makes it short
    "blinkgl generate configs/eflow/smoke_data.yaml --out out/smoke_data --workers 2": None,  # a tiny set is there
    "eflow train configs/eflow/smoke.yaml --out out/smoke": NETWORK,
    "eflow evaluate out/smoke out/smoke_data/test --out out/scores": "--limit 1",
    "eflow predict out/smoke recording.raw --out out/flow": "--window-ms 90",
    "eflow predict recording.raw --window-ms auto --video flow.mp4": "",
    "eflow train --model ev_flownet-tiny --data out/smoke_data/train --minutes 10 --out out/mine": NETWORK,
    "eflow render configs/eflow/real_data.yaml --samples 20000 --window-ms 5-100 --seed 1 --out out/real_windows": None,
    "eflow train configs/eflow/real.yaml --out out/a --set data.train='[{path: ../../out/real_windows}]' --set seed=1":
        NETWORK,
    "eflow import dsec.tar --out eraft_dsec.safetensors": "",
    "eflow evaluate eraft_dsec.safetensors /data/dsec/train": "--iterations 1 --limit 1",
    "eflow models": "",
    "eflow models NAME": "",
    "eflow train configs/eflow/finetune.yaml --out out/mine --set init_from=NAME": SHORT,
    "eflow export out/smoke --onnx flow.onnx --size 640x480": "--size 32x32",
    "eflow predict contrast-affine recording.raw --window-ms 20 --out out/flow": "--end-ms 60",
}  # fmt: skip


def documented() -> list[str]:
    text = (ROOT / "docs/eflow.md").read_text()
    inline = re.findall(r"`(eflow train --model [^`]*)`", text)
    lines = [*(line.replace("\n", " ") for line in inline), *text.splitlines()]
    return [line.partition("  #")[0].strip() for line in lines if re.match(r"(eflow|blinkgl) [a-z]+ ?(?!takes)", line)]


def test_the_page_has_these_commands():
    assert set(documented()) == set(COMMANDS)


def test_they_run_one_after_the_other(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "configs", "configs")
    for split in ("train", "test"):
        blinkgl_set(tmp_path / "made", sequences=1, labels=2)
        Path("out/smoke_data").mkdir(parents=True, exist_ok=True)
        shutil.move("made/train", f"out/smoke_data/{split}")
    shutil.copytree("out/smoke_data/train", "out/real_windows")
    dsec_set(tmp_path / "data/dsec/train")
    write_events("recording.raw", moving_events(128, 144, 0, 3 * SPAN, n=20_000), 128, 144)
    torch.save({"state_dict": published()}, "dsec.tar")
    for command in documented():
        for name in ("real_small", "real_bodies") if "NAME" in command else ("",):
            for made in (made for made in ("out/flow", "out/mine") if made in command):
                shutil.rmtree(made, ignore_errors=True)
            if (short := COMMANDS[command]) is None:
                continue
            if "--onnx" in command and importlib.util.find_spec("onnxscript") is None:  # extra onnx
                continue
            words = shlex.split(f"{command} {short}".replace("NAME", name).replace("/data/", f"{tmp_path}/data/"))
            assert run(words[1:]) == 0, f"{command}: {capsys.readouterr().err}"
    assert json.loads(Path("out/scores/results.json").read_text())["samples"] == 1
    assert yaml.safe_load(Path("out/mine/config.yaml").read_text())["model"]["name"] == "eflowformer"


@pytest.mark.slow
def test_those_that_render(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "configs", "configs")
    generate, render = (command for command, short in COMMANDS.items() if short is None)
    words = shlex.split(generate) + ["--num", "1", "--set", "camera={width: 64, height: 48}", "--workers", "1"]
    assert cli.run(words[1:]) == 0, capsys.readouterr().err
    assert run([*shlex.split(render)[1:], "--samples", "2"]) == 0, capsys.readouterr().err
