"""When to draw the next event frame."""

from blinkgl.timeline.sampling import Ticks, bounded_times, displacement_times, uniform_times
from blinkgl.timeline.strategy import Timeline, make_timeline

__all__ = ["Ticks", "Timeline", "bounded_times", "displacement_times", "make_timeline", "uniform_times"]
