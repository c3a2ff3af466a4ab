"""One self-contained HTML page about a data set: examples, distributions, coverage of the recipe, cost, failures.

In:    the folder of a data set.
Out:   report.html and index.jsonl.
Start: page.py (``build_report``) and templates/data_set.html; collect.py gathers, charts.py
counts and fills in any room's templates. calibration.py is the page of a fitted emulator.
"""

from blinkgl.report.page import build_report, write_report

__all__ = ["build_report", "write_report"]
