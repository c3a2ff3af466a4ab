"""Two examples of each command of ``blinkgl``, for its help and docs/commands.md. A test parses each."""

from __future__ import annotations

BLINKGL: dict[str, tuple[str, ...]] = {
    "doctor": ("", "--json"),
    "configs": ("", "| grep kubric"),
    "generate": ("demo --out out/demo", "my.yaml --out out/mine --num 100 --workers 4 --resume"),
    "view": ("out/demo", "out/demo/train/demo_000000 --save demo.html"),
    "verify": ("out/demo", "out/demo --deep --sample 10"),
    "drop": ("out/demo train/demo_000003", "out/demo --where 'events < 1000'"),
    "explain": ("demo", "my.yaml --set camera.width=640 --set quality=accurate"),
    "trade": ("my.yaml --quick --out out/trade", "--suite --scene rods --out out/suite"),
    "report": ("out/demo", "out/demo --examples 8 --out out/page.html"),
    "export": ("out/demo --out out/shards", "out/demo --layout dsec --out out/as_dsec"),
    "simulate": (
        "clip.mp4 --emulator v2e -o events.h5 --preview look.mp4",
        "frames/ --fps 240 --sensor davis346 -o events.aedat4",
    ),
    "saccade": (
        "pictures/ --classes-from folders --out out/clips",
        "pictures/ --size 240x180 --path way.csv --out out/clips",
    ),
    "compare": ("real.txt simulated.h5", "real.txt simulated.h5 --frames frames/ --out report/"),
    "calibrate": (
        "dark.aedat4 --still --emulator v2e --out noise.yaml",
        "events.txt --frames frames/ --timestamps t.txt -o mine.yaml",
    ),
    "convert": ("recording.raw recording.h5", "stranger.npz --look"),
    "import": ("scene.blend --out scene.glb", "figure.fbx --clips --out figure.glb"),
    "shader passes": ("demo --out out/passes", "demo --pass depth --pass colour --out out/two"),
    "shader probe": ("demo --pixel 200,120", "demo --pixel 200,120 --time 0.2 --json"),
    "shader diff": ("demo", "demo --pass flow_forward --tolerance 0.01 --out out/diff"),
    "shader check": ("", "luminance.glsl --shaders my_shaders"),
    "shader show": ("label.glsl", "label.glsl --stage fragment -D OUT_VELOCITY=0 --numbers"),
    "shader serve": ("demo", "demo --shaders my_shaders --port 8800"),
}
"""Command -> what follows its name."""
