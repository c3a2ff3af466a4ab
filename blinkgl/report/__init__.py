"""One self-contained HTML page about a data set: examples, distributions, coverage of the recipe, cost, failures.

In:    the folder of a data set.
Out:   report.html and index.jsonl.
Start: page.py (``build_report``) and templates/data_set.html. collect.py collects the data; charts.py makes histograms
and renders the templates of any room. calibration.py makes the page of a fitted emulator.
"""
