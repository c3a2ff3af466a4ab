"""One self-contained HTML page about a data set: examples, distributions, coverage of the recipe, cost, failures.

In:    the folder of a data set.
Out:   report.html.
Start: page.py (``build_report``); collect.py gathers, charts.py draws.
"""

from blinkgl.report.page import build_report, write_report

__all__ = ["build_report", "write_report"]
