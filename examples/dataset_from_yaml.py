"""A data set from a YAML file, made and checked in Python; the contrast threshold is drawn for every sequence."""

from pathlib import Path

from blinkgl import generate, load, read_events, verify

YAML = """
seed: 4
camera: {width: 96, height: 72}
time: {duration: 0.2, label_rate: 10}
scene:
  kind: random
  objects: {count: 3}
  pool: {primitives: [cuboid, sphere]}
  textures: {photographs: false, max_size: 128}
events: {emulator: esim, contrast_threshold: {uniform: [0.15, 0.3]}}
preview: {enabled: false}
"""


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    (out / "run.yaml").write_text(YAML)
    run = load(out / "run.yaml", ["labels.depth=true"])
    outcome = generate(run, out / "data", num=2)
    for index in range(2):
        folder = out / f"data/train/sequence_{index:06d}"
        print(
            f"{folder.name}: threshold {run.sequence(index).events.contrast_threshold:.3f}, "
            f"{len(read_events(folder / 'events.h5'))} events"
        )
    print(
        f"{outcome.made.count} sequences, {outcome.made.labels} labels; checked: "
        f"{'clean' if verify(out / 'data').clean else 'damaged'}"
    )


def test_final(out: Path) -> None:
    assert verify(out / "data").clean
    for index in range(2):
        assert len(list((out / f"data/train/sequence_{index:06d}/flow/forward").glob("*.png"))) == 2
        assert len(list((out / f"data/train/sequence_{index:06d}/depth").glob("*.npy"))) == 2


if __name__ == "__main__":
    main(Path("out/examples/dataset_from_yaml"))
