"""What labels cost: processor time of each at label times one after another, drawn, read back and finished, in ms and
in luminance frames; and of writing it.

    python -m blinkgl.tools.bench_labels [configs/demo.yaml] [--size 640x480] [--rate 100] [--times 24]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from blinkgl.config.sequence import load_run
from blinkgl.gl import create_context
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.render.renderer import Renderer
from blinkgl.scene.build import sequence_scene

_CONFIG = Path(__file__).resolve().parent.parent / "configs" / "demo.yaml"
_BOTH = ("flow_forward", "flow_backward", "occlusion_forward", "occlusion_backward")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("config", nargs="?", default=str(_CONFIG))
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--times", type=int, default=24)
    options = parser.parse_args()
    width, height = options.size.split("x")
    size = [f"camera.width={width}", f"camera.height={height}", f"time.label_rate={options.rate}"]
    path = Path(options.config)
    config = load_run(path, [*size, f"time.duration={(options.times + 4) / options.rate}"]).sequence(0)
    span, times = config.time.interval_ns, config.time.label_times_ns[: options.times + 2]
    sets = [(name,) for name, label in LABELS.items() if label.buffer or (label.needs and label.towards is None)]
    sets += [("flow_forward", "occlusion_forward"), _BOTH, ("images",)]
    with create_context() as gl, Renderer(gl, sequence_scene(config, 0, path.parent), config.render) as renderer:
        frame = _median(lambda t: renderer.luminance(t).read(), times)
        print(f"luminance frame {frame:.1f} ms (processor time, median of {options.times})")
        print(f"{'label':72} {'drawn, ms':>10} {'frames':>7} {'written, ms':>12} {'kB':>7}")
        for names in sets:
            request = LabelRequest(*names)
            drawn = _median(lambda t, request=request: renderer.labels(t, request, t + span, t - span), times)
            values = renderer.labels(times[2], request, times[3], times[1]).values
            written, size_kb = zip(*(_written(name, values[name], times) for name in names))
            said = f"{', '.join(names):72} {drawn:10.1f} {drawn / frame:7.2f} {sum(written):12.1f} {sum(size_kb):7.0f}"
            print(said, flush=True)


def _median(draw: Callable[[int], object], times: range) -> float:
    """ms of processor time of one of the times, after two that compile and fill."""
    spent = []
    for t_ns in times:
        started = time.process_time()
        draw(t_ns)
        spent.append(time.process_time() - started)
    return 1e3 * float(np.median(spent[2:]))


def _written(name: str, value: object, times: range) -> tuple[float, float]:
    """ms of processor time for its first form, and kB of it."""
    encode, sizes = LABELS[name].forms[0].encode, []
    assert encode is not None

    def once(_: int) -> None:
        data = encode(value)
        sizes.append(len(data[0] if isinstance(data, tuple) else data))

    return _median(once, times[:8]), sizes[-1] / 1e3


if __name__ == "__main__":
    main()
