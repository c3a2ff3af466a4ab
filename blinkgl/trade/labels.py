"""How wrong the flow labels of a setting are, by casting float64 rays at a sample of pixels
into the scene as it was described."""

from __future__ import annotations

import numpy as np

from blinkgl.labels import LabelRequest
from blinkgl.render import casting
from blinkgl.render.renderer import Renderer
from blinkgl.scene.types import Scene

PIXELS = 300
_AROUND = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)], float)


def flow_errors(scene: Scene, renderer: Renderer, t_ns: int, t_next_ns: int, seed: int = 0) -> dict[str, float]:
    """Error of the forward flow in px, median and maximum, over ``PIXELS`` random pixels off
    silhouettes; NaN where there are none.

    scene : the scene with all its triangles, whatever the renderer draws instead of it. A pixel counts where it and its
    four neighbours see one instance, the renderer agrees on which, and the flow is valid on both sides."""
    height, width = renderer.height, renderer.width
    rng = np.random.default_rng(seed)
    xy = np.stack([rng.integers(0, width, PIXELS), rng.integers(0, height, PIXELS)], axis=1)
    hits = casting.cast(scene, t_ns, (xy[:, None] + _AROUND).reshape(-1, 2))
    ids = hits.instance.reshape(PIXELS, len(_AROUND))
    exact = casting.flow_to(scene, hits, t_next_ns)
    flow, valid = exact.flow.reshape(PIXELS, len(_AROUND), 2)[:, 0], exact.valid.reshape(PIXELS, -1)[:, 0]
    ours = renderer.labels(t_ns, LabelRequest("ids", "flow_forward"), t_next_ns)
    x, y = xy.T
    counts = (
        (ids == ids[:, :1]).all(axis=1)
        & (ids[:, 0] > 0)
        & (ours.ids[y, x] == ids[:, 0])
        & valid
        & ours.forward.valid[y, x]
    )
    error = np.hypot(*(ours.forward.flow[y, x] - flow)[counts].T)
    return {
        "flow_median_px": float(np.median(error)) if len(error) else float("nan"),
        "flow_max_px": float(error.max(initial=0)) if len(error) else float("nan"),
    }
