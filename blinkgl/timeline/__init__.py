"""When to draw the next event frame."""

from blinkgl.timeline.sampling import displacement_times, frame_times, uniform_times

__all__ = ["displacement_times", "frame_times", "uniform_times"]
