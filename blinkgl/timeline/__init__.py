"""The times of event frames.

In:    a configuration, the speeds of a scene, small pictures of its brightness.
Out:   frame times, int64 ns, increasing.
Start: strategy.py (``make_timeline``); sampling.py has the arithmetic, interpolate.py interpolates frames of a
video.
"""

from blinkgl.timeline.sampling import Ticks, bounded_times, uniform_times
from blinkgl.timeline.strategy import Timeline, make_timeline, together

__all__ = ["Ticks", "Timeline", "bounded_times", "make_timeline", "together", "uniform_times"]
