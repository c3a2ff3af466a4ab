"""The page of single-pixel noise fitted to a static scene, compared with the recording."""

from __future__ import annotations

from blinkgl.recordings.pixel_noise import PixelFit
from blinkgl.report.charts import render


def page(result: PixelFit, sensor_text: str) -> str:
    """Return the HTML text. sensor_text : text of the sensor file."""
    return render(
        "report/pixel_noise.html",
        title=f"noise of single pixels fitted to {result.recording.rsplit('/', 1)[-1]}",
        result=result,
        rows=rows(result),
        parameters=parameters(result),
        sensor=sensor_text,
    )


def rows(result: PixelFit) -> list[tuple[str, str, str]]:
    """Return (quantity, recorded, fitted) of the half that was not fitted, as text."""
    return [
        ("events", f"{result.recorded:,}", f"{result.simulated:,}"),
        ("pixels that fired", f"{result.fired[0]:,}", f"{result.fired[1]:,}"),
        ("events of a pixel that fired, KS", "0", f"{result.counts_distance:.3f}"),
        ("interval between a pixel's events, KS", "0", f"{result.intervals_distance:.3f}"),
    ]


def parameters(result: PixelFit) -> list[tuple[str, str, str]]:
    """Return (key, fitted, remark)."""
    table = []
    for key, field in type(result.config).model_fields.items():
        value = getattr(result.config, key)
        if key in result.undetermined:
            table.append((f"readout.pixels.{key}", "", result.undetermined[key]))
        elif value != field.default:
            spread = result.uncertainty.get(key)
            text = f"{value:.4g}" + (f" ± {spread:.2g}" if spread is not None else "")
            table.append((f"readout.pixels.{key}", text, field.description or ""))
    return table
