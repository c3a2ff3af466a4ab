"""Flow that comes with recorded frames, compared with them: of another unit, direction or order, it explains them worse
than no motion, or than itself times another factor."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

FACTORS = (0.0, 0.5, 1.0, 2.0, -1.0)
"""What the flow is multiplied by: none, other quanta (1/128 and 1/64 px), the other direction."""
_BETTER = 0.85
"""Share of the error of the flow as it is that another factor has to leave to be believed."""
_MOVES_PX, _LEAST_PX = 0.5, 256
"""Flow below which, and number of pixels with which, nothing can be told."""


def factor_that_fits(
    pairs: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]],
) -> tuple[float, float, float] | None:
    """Return (factor, its error, error of the flow as it is) where another factor of ``FACTORS`` explains the images
    better, else None.

    pairs : (image, the next one, flow (H, W, 2) px from the first to the second, valid (H, W) bool); images (H, W) or
    (H, W, 3) of any type. Errors are means of the absolute difference along the flow, over pixels that move, have
    contrast and stay inside, as shares of the images' contrast."""
    errors = np.zeros(len(FACTORS))
    for a, b, flow, valid in pairs:
        # Blurred: noise of single pixels differs between the images, whatever the factor.
        first, second = (cv2.GaussianBlur(_grey(image), (0, 0), 1.0) for image in (a, b))
        row, column = np.indices(first.shape, np.float32)
        slope = np.abs(cv2.Sobel(first, cv2.CV_32F, 1, 0)) + np.abs(cv2.Sobel(first, cv2.CV_32F, 0, 1))
        moving = valid & (np.abs(flow).max(axis=-1) > _MOVES_PX) & (slope > np.median(slope))
        ends = [
            (column + np.float32(factor) * flow[..., 0], row + np.float32(factor) * flow[..., 1]) for factor in FACTORS
        ]
        for x, y in ends:
            # The same pixels for every factor: those that stay inside with all of them.
            moving &= (x >= 0) & (y >= 0) & (x <= first.shape[1] - 1) & (y <= first.shape[0] - 1)
        if np.count_nonzero(moving) < _LEAST_PX:
            continue
        scale = float(np.std(first)) or 1.0
        for k, end in enumerate(ends):
            x, y = (places.astype(np.float32) for places in end)
            followed = cv2.remap(second, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            errors[k] += float(np.abs(followed - first)[moving].mean()) / scale
    own = errors[FACTORS.index(1.0)]
    best = int(np.argmin(errors))
    if FACTORS[best] == 1.0 or not errors[best] < _BETTER * own:
        return None
    return FACTORS[best], float(errors[best]), float(own)


def _grey(image: np.ndarray) -> np.ndarray:
    image = image.astype(np.float32)
    return image if image.ndim == 2 else image.mean(axis=2)
