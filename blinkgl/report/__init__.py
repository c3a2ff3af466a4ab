"""One self-contained HTML page about a data set: examples, distributions, coverage of the recipe, cost, failures."""

from blinkgl.report.page import build_report, write_report

__all__ = ["build_report", "write_report"]
