"""Images of warped events: all events of a window, moved along a flow to one time.

With the right flow, the events of an edge fall on one line, so the image is sharp (Gallego, Rebecq and Scaramuzza, CVPR
2018; Stoffregen et al., ECCV 2020).
"""

from __future__ import annotations

import numpy as np

from blinkgl.machine.kernels import kernel
from eflow.data.window import Window
from eflow.types import Flow, Numbers


@kernel
def vote(x: Numbers, y: Numbers, image: Numbers) -> None:
    """Add 1 for every point (x, y), float64 px, to its four pixels, bilinearly; points outside are ignored."""
    height, width = image.shape
    for i in range(len(x)):
        fx, fy = np.floor(x[i]), np.floor(y[i])
        if not (fx >= 0 and fy >= 0 and fx < width - 1 and fy < height - 1):
            continue
        column, row = int(fx), int(fy)
        a, b = x[i] - fx, y[i] - fy
        image[row, column] += (1 - a) * (1 - b)
        image[row, column + 1] += a * (1 - b)
        image[row + 1, column] += (1 - a) * b
        image[row + 1, column + 1] += a * b


@kernel
def slope_at(x: Numbers, y: Numbers, image: Numbers, out: Numbers) -> None:
    """Write the derivative of sum(image * votes) by x and y of each point to out (N, 2): the adjoint of
    :func:`vote`."""
    height, width = image.shape
    for i in range(len(x)):
        fx, fy = np.floor(x[i]), np.floor(y[i])
        if not (fx >= 0 and fy >= 0 and fx < width - 1 and fy < height - 1):
            out[i, 0] = out[i, 1] = 0.0
            continue
        column, row = int(fx), int(fy)
        a, b = x[i] - fx, y[i] - fy
        # d/da and d/db of (1-a)(1-b) p + a(1-b) q + (1-a)b r + ab s.
        p, q = image[row, column], image[row, column + 1]
        r, s = image[row + 1, column], image[row + 1, column + 1]
        out[i, 0] = (q - p) * (1 - b) + (s - r) * b
        out[i, 1] = (r - p) * (1 - a) + (s - q) * a


def warped(window: Window, flow: Flow) -> Numbers:
    """Return the image (H, W) float64 of the events of a window, moved back along ``flow`` to its start.

    flow : (H, W, 2) px per length of the window, read at each event's pixel."""
    height, width = flow.shape[:2]
    image = np.zeros((height, width))
    column, row = (np.rint(np.asarray(c)).astype(np.intp) for c in (window.x, window.y))
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    share = (window.t[inside] - window.t0) / (window.t1 - window.t0)
    moved = flow[row[inside], column[inside]] * share[:, None]
    vote(window.x[inside] - moved[:, 0].astype(np.float64), window.y[inside] - moved[:, 1].astype(np.float64), image)
    return image


def flow_warp_loss(window: Window, flow: Flow) -> float:
    """Return the flow warp loss (Stoffregen et al., ECCV 2020, eq. 6): the variance of the image of warped events over
    that of the events themselves.

    Above 1 the flow makes the image sharper; zero flow has 1; without events it is NaN. flow : (H, W, 2) px over the
    window."""
    before = warped(window, np.zeros_like(flow)).var()
    return float(warped(window, flow).var() / before) if before > 0 else float("nan")
