"""What ``blinkgl verify`` finds: every kind of damage by its message, and nothing in a sound data set."""

import contextlib
import json
import os
import re
import shutil
import signal
from functools import partial
from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401
import numpy as np
import pytest

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.dataset.cross_checks import guarded
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.dataset.verify import verify_dataset
from blinkgl.errors import AssetError
from blinkgl.io.records import sealed
from blinkgl.sequence_files.sequence_dir import manifest_problems, verify_sequence
from runs import NAMES, forge, recipe_file


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sound")
    run_dataset(load_run(recipe_file(folder), ["groups.fly.output.sequences=2"]), folder / "out")
    return folder / "out"


@pytest.fixture
def data(sound, tmp_path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "data"))


def drop(sequence: Path, name: str) -> None:
    """Takes a file and its line in the manifest away."""
    (sequence / name).unlink()
    manifest = json.loads((sequence / "manifest.json").read_text())
    del manifest["files"][name]
    (sequence / "manifest.json").write_text(sealed(manifest))


@contextlib.contextmanager
def no_longer_than(seconds: int):
    """A test that would wait for ever fails instead."""

    def stop(*_):
        raise TimeoutError("it hangs")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def edit_events(sequence: Path, **columns) -> None:
    with h5py.File(sequence / "events.h5", "r+") as file:
        for name, change in columns.items():
            dataset = file["ms_to_idx" if name == "ms_to_idx" else f"events/{name}"]
            dataset[...] = change(dataset[...])
    forge(sequence, "events.h5")


def test_a_sound_data_set_and_its_parts(sound, capsys):
    assert verify_dataset(sound).clean
    assert run(["verify", str(sound), "--deep", "--sample", "4"]) == 0
    assert "4 sequences, 4 made again and compared bit by bit: no problem found" in capsys.readouterr().out
    assert verify_dataset(sound / "train").sequences == 2 and verify_dataset(sound / NAMES[0]).clean


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda s: flip(s / "events.h5"), "events.h5: checksum differs"),
        (lambda s: flip(s / "flow/forward/000001.png"), "flow/forward/000001.png: checksum differs"),
        (
            lambda s: (s / "images/000000.png").write_bytes((s / "images/000000.png").read_bytes()[:-10]),
            "images/000000.png: ",
        ),
        (lambda s: (s / "poses.npz").unlink(), "poses.npz: missing"),
        (lambda s: (s / "flow/forward/notes.txt").write_text("x"), "flow/forward/notes.txt: not in the manifest"),
        (lambda s: (s / "manifest.json").write_text("{"), "damaged manifest"),
        (lambda s: forge(s, "", labels=9), "manifest.json: labels is 9, config.yaml says 4"),
        (lambda s: drop(s, "ids/000002.png"), "ids/000002.png: missing, config.yaml asks for it"),
        (
            lambda s: ((s / "depth").mkdir(), (s / "depth/000000.npy").write_text("x"), forge(s, "depth/000000.npy")),
            "depth/000000.npy: config.yaml does not ask for it",
        ),
        (lambda s: os.symlink("events.h5", s / "also.h5"), "also.h5: a symbolic link"),
        (lambda s: os.symlink("flow", s / "more"), "more: a symbolic link"),
        (lambda s: ((s / "poses.npz").rename(s / "p"), os.symlink("p", s / "poses.npz")), "p: not in the manifest"),
        (lambda s: ((s / "events.h5").unlink(), os.mkfifo(s / "events.h5")), "events.h5: a special file"),
        (lambda s: ((s / "config.yaml").unlink(), os.mkfifo(s / "config.yaml")), "config.yaml: a special file"),
        (
            lambda s: ((s / "manifest.json").unlink(), os.mkfifo(s / "manifest.json")),
            "manifest.json: not a regular file",
        ),
        (lambda s: (s / "images/more").mkdir(), "images/more: an empty folder"),
        (lambda s: (s / os.fsdecode(b"caf\xe9\x1b[31m")).write_text("x"), "caf\\udce9\\x1b[31m: not in the manifest"),
        (lambda s: forge(s, "", sequence=1), "manifest.json: sequence is 1, config.yaml says 0"),
        (lambda s: forge(s, "", seed=3), "manifest.json: seed is 3, config.yaml says"),
        (lambda s: forge(s, "", split="test"), "manifest.json: split is test, config.yaml says train"),
        (lambda s: forge(s, "", duration_us=200_000), "manifest.json: duration_us is 200000, config.yaml says 250000"),
        (lambda s: ((s / "config.yaml").write_text("seed: ["), forge(s, "config.yaml")), "not valid YAML"),
        (lambda s: forge(s, "", seed=None), "manifest.json: 'seed' is missing or no int"),
    ],
)
def test_damage_inside_a_sequence(data, damage, message):
    damage(data / NAMES[0])
    (data / "index.jsonl").unlink()
    with no_longer_than(60):
        problems = verify_dataset(data).problems
    assert list(problems) == [NAMES[0]] and len(problems[NAMES[0]]) <= 2 and message in problems[NAMES[0]][0]


@pytest.mark.parametrize(
    "damage, message",
    [
        (lambda d: shutil.rmtree(d / NAMES[0]), "missing: the recipe asks for it"),
        (lambda d: (d / "train/readme.txt").write_text("x"), "train/readme.txt: belongs to no sequence"),
        (
            lambda d: (
                (d / "train/.fly_000000.blinkgl-tmp-0123456789ab-1-0").mkdir()
                or (d / "train/.fly_000000.blinkgl-tmp-0123456789ab-1-0/events.h5").write_text("")
            ),
            "left by a run that was cut off",
        ),
        (
            lambda d: (d / "index.jsonl").write_text(
                (d / "index.jsonl").read_text().replace('"events": ', '"events": 1')
            ),
            "index.jsonl: out of date for",
        ),
        (lambda d: (d / "index.jsonl").write_text('{"path": "../x"}\n'), "index.jsonl: damaged index"),
        (lambda d: (d / ".run/run.json").write_text("["), "the run's record is damaged"),
        (
            lambda d: (d / "index.jsonl").write_text(2 * (d / "index.jsonl").read_text()),
            "index.jsonl: damaged index: test/probe_000000 is listed twice",
        ),
        (lambda d: pipe(d / "index.jsonl"), "index.jsonl: not a regular file"),
        (lambda d: pipe(d / ".run/run.json"), "run.json: the run's record is damaged: not a regular file"),
        (lambda d: pipe(d / ".run/recipe.yaml"), "recipe.yaml: not a regular file"),
        (
            lambda d: swap(d / NAMES[0], d / NAMES[1]),
            f"{NAMES[0]}: the folder is called {NAMES[0]}, but holds {NAMES[1]}",
        ),
        (
            lambda d: shutil.copytree(d / NAMES[0], d / "train/fly_000002"),
            "train/fly_000002: the folder is called train/fly_000002, but holds train/fly_000000",
        ),
        (
            lambda d: (d / NAMES[0]).rename(d / "test/fly_000000"),
            "test/fly_000000: the folder is called test/fly_000000, but holds train/fly_000000",
        ),
        (
            lambda d: ((d / NAMES[1]).rename(d / "x"), (d / NAMES[1]).symlink_to(d / "x")),
            f"{NAMES[1]}: a symbolic link, which is not followed",
        ),
        (
            lambda d: renumber(shutil.copytree(d / NAMES[0], d / "train/fly_000002"), 2),
            "train/fly_000002: events.h5: the same as in train/fly_000000",
        ),
        (
            lambda d: renumber(shutil.copytree(d / NAMES[0], d / "train/fly_000002"), 2),
            "train/fly_000002: poses.npz: the same as in train/fly_000000",
        ),
        (
            lambda d: configure(d / NAMES[0], "contrast_threshold", 0.25),
            f"{NAMES[0]}: config.yaml: the recipe draws another value for events.contrast_threshold",
        ),
        (
            lambda d: configure(d / NAMES[0], "name", "gnu") or (d / NAMES[0]).rename(d / "train/gnu_000000"),
            "train/gnu_000000: no group of the recipe makes it",
        ),
        (
            lambda d: forge(d / NAMES[0], "", opengl={"renderer": "Voodoo", "version": "1"}),
            "made with opengl Voodoo, 1, the run's record says",
        ),
    ],
)
def test_damage_between_sequences(data, capsys, damage, message):
    damage(data)
    for command in ("verify", "report"):
        with no_longer_than(60):
            status = run([command, str(data)])
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        if command == "verify":
            assert status == 2 and message in said.out


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def swap(a: Path, b: Path) -> None:
    a.rename(a.with_name("between"))
    b.rename(a)
    a.with_name("between").rename(b)


def configure(sequence: Path, key: str, value) -> None:
    """Another value in the sequence's own configuration, with a manifest that fits."""
    path = sequence / "config.yaml"
    path.write_text(re.sub(rf"(?m)^( +){key}: .*$", rf"\g<1>{key}: {value}", path.read_text(), count=1))
    forge(sequence, "config.yaml")


def renumber(sequence: Path, number: int) -> None:
    configure(sequence, "first_index", number)
    forge(sequence, "", sequence=number)


RECORDS = (f"{NAMES[0]}/manifest.json", *(f".run/{name}.json" for name in ("run", "assets", "checksums")))
RECORDS += (".run/costs.jsonl", ".run/recipe.yaml")


@pytest.fixture(scope="module")
def stereo(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("stereo")
    run_dataset(load_run(recipe_file(folder, rig="stereo")), folder / "out", num=1)
    return folder / "out"


def edited(path: Path, data: bytes, at: int, bit: int) -> None:
    path.write_bytes(data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :])


@pytest.mark.parametrize("record", RECORDS)
def test_an_edited_byte_of_a_record_is_noticed(data, record):
    """Any byte: of values that nothing else is compared with, of names, of blanks."""
    path, rng = data / record, np.random.default_rng(0)
    whole = path.read_bytes()
    for at in (0, len(whole) - 1, *rng.integers(0, len(whole), 2).tolist()):
        edited(path, whole, at, int(rng.integers(0, 8)))
        assert not verify_dataset(data).clean, at
    path.write_bytes(whole)
    assert verify_dataset(data).clean


@pytest.mark.slow
def test_every_edited_byte_of_every_record_is_noticed(sound, stereo, tmp_path):
    """One bit of each byte, a rig's records included; what is called are the checks that ``verify`` ends with."""
    checked = 0
    for source in (sound, stereo):
        root = Path(shutil.copytree(source, tmp_path / source.parent.name))
        for path in (*root.rglob("manifest.json"), *(p for p in (root / ".run").iterdir() if p.is_file())):
            own = RunFolder(root).altered if path.parent.name == ".run" else partial(look_at_records, path.parent, root)
            whole = path.read_bytes()
            for at in range(len(whole)):
                edited(path, whole, at, at % 8)
                assert guarded(own), (path, at)
            path.write_bytes(whole)
            assert not guarded(own)
            checked += len(whole)
    assert checked > 20_000


def look_at_records(folder: Path, root: Path) -> list[str]:
    """Of a sequence's manifest, and of those of its rig's cameras."""
    above = folder.parent if (folder.parent / "rig.yaml").exists() else folder
    return manifest_problems(folder) or verify_sequence(above, checksums=False)


def test_data_sets_without_hashes_of_their_records_are_verified_as_before(data):
    """Those of format_version 1; but a record that says 1 and has a hash is held to it."""
    for name in NAMES[:2]:
        manifest = json.loads((data / name / "manifest.json").read_text())
        del manifest["record_sha256"]
        (data / name / "manifest.json").write_text(json.dumps(manifest | {"format_version": 1}))
    record = json.loads((data / ".run/run.json").read_text())
    (data / ".run/run.json").write_text(json.dumps(record | {"format_version": 1}))
    assert ".run/run.json: checksum differs" in verify_dataset(data).problems["."]
    (data / ".run/checksums.json").unlink()
    assert verify_dataset(data, deep=4).clean
    (data / ".run/run.json").write_text(json.dumps(record))
    assert verify_dataset(data).problems == {".": [".run/checksums.json: missing"]}


def test_a_rigs_manifest_is_held_to_its_hash(stereo, tmp_path):
    """Its hashes of sources and its group are compared with nothing else."""
    data = Path(shutil.copytree(stereo, tmp_path / "data"))
    path = next(data.glob("train/*/manifest.json"))
    record = json.loads(path.read_text())
    assert verify_dataset(data).clean
    texts = [json.dumps({**record, "group": "another"}, indent=1, sort_keys=True) + "\n"]
    text = json.dumps(record, indent=1, sort_keys=True) + "\n"
    at = text.index("_hash")
    at = text.index('"', text.index(":", at)) + 1
    texts.append(text[:at] + chr(ord(text[at]) ^ 1) + text[at + 1 :])
    for edited_text in texts:
        assert edited_text != text
        path.write_text(edited_text)
        name = path.parent.relative_to(data).as_posix()
        assert verify_dataset(data).problems == {name: ["manifest.json: checksum differs"]}


DEEP = "[" * 100_000
LONG = "n" * 5000
MANIFESTS = [
    DEEP,
    '{"files": ' + DEEP,
    "[]",
    "null",
    "7",
    '"x"',
    "\x00",
    "{}",
    '{"a": 1, "a": 2}',
    "\ud800",
    {"files": []},
    {"files": None},
    {"files": {"a\x00b": None}},
    {"format": "other"},
    {"format_version": 3},
    {"sequence": -1},
    {"sequence": 1.5},
    {"sequence": 10**30},
    {"events": -1},
    {"events": "many"},
    {"events": True},
    {"height": 0},
    {"width": 1e9},
    {"t_offset_us": None},
    {"duration_us": -5},
    {"labels": [4]},
    {"split": 3},
    {"split": "x" * 5000},
    {"seed": "11"},
    {"emulator": {"a": 1}},
    {"opengl": "none"},
    {"opengl": {"renderer": 3}},
    {"versions": 5},
    {"frames": DEEP[:900]},
    '{"seed": ' + "9" * 6000 + "}",
]
FILES = ["", "/etc/passwd", "../x", "a/../b", "a//b", ".", "x\x00y", LONG, "d/" * 600 + "f", "\udce9"]


ENTRIES = [
    {},
    5,
    {"bytes": "1", "sha256": "0" * 64},
    {"bytes": -1, "sha256": "0" * 64},
    {"bytes": 1, "sha256": LONG},
    {"bytes": 1, "sha256": None},
]


def test_no_manifest_stops_it(data, capsys):
    """One line for the sequence, whatever stands there; the others are looked at all the same."""
    (data / "index.jsonl").unlink()
    shutil.rmtree(data / ".run")
    shutil.rmtree(data / "test")
    path = data / NAMES[0] / "manifest.json"
    manifest = json.loads(path.read_text())
    files = manifest["files"]
    changes = (
        MANIFESTS
        + [{"files": {**files, name: files["events.h5"]}} for name in FILES]
        + [{"files": {**files, "events.h5": e}} for e in ENTRIES]
    )
    for number, change in enumerate(changes):
        text = change if isinstance(change, str) else json.dumps({**manifest, **change})
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        problems = verify_dataset(data).problems
        assert list(problems) == [NAMES[0]], text[:200]
        [line] = problems[NAMES[0]]
        assert "damaged manifest: " in line or "manifest.json" in line, line
        assert len(line) < 500 and line.isprintable()
        if number % 8 == 0:
            for command in (
                ["verify", str(data)],
                ["report", str(data)],
                ["export", str(data), "--out", str(data / f"x{number}")],
            ):
                assert run(command) in (0, 2) and "Traceback" not in capsys.readouterr().err


def test_nothing_is_passed_over_in_silence(data, capsys):
    """Of a sequence of another machine the manifest is compared, which the last line says."""
    for name in NAMES[:2]:
        forge(data / name, "", opengl={"renderer": "Voodoo", "version": "1", "vendor": "3dfx", "backend": "egl"})
    shutil.rmtree(data / ".run")
    (data / "index.jsonl").unlink()
    edit_events(data / NAMES[0], x=lambda x: x[::-1].copy())
    assert run(["verify", str(data), "--deep", "--sample", "9"]) == 0
    said = capsys.readouterr().out
    assert "note: no record of the run here" in said
    assert (
        f"note: {NAMES[0]}: made with opengl Voodoo, 1, this machine has" in said
        and "the bytes of its files were not compared" in said
    )
    assert (
        "4 sequences, 2 made again and compared bit by bit, 2 made again and compared in part: no problem found in "
        "what could be compared"
    ) in said


def test_deep_finds_what_checksums_cannot(data, capsys):
    """One event a column further, under a manifest that fits."""
    edit_events(data / NAMES[1], x=lambda x: (x + (np.arange(len(x)) == 5)) % 64)
    (data / "index.jsonl").unlink()
    assert verify_dataset(data).clean
    assert run(["verify", str(data), "--deep", "--sample", "9"]) == 2
    said = capsys.readouterr().out
    assert f"{NAMES[1]}: made again, events.h5: differs" in said and f"{NAMES[0]}:" not in said


def test_nothing_to_verify(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(AssetError, match="no sequence found|no such data set"):
            verify_dataset(path)


def test_a_check_that_stops_is_a_line():
    assert guarded(lambda: 1 / 0) == ["cannot be checked: ZeroDivisionError: division by zero"]
