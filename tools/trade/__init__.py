"""Cost of accuracy (``blinkgl trade``).

In:    one configuration, settings to try.
Out:   their cost, and their error against a reference that is refined until it converges.
Start: run.py (``trade``); measure.py times, matching.py and metrics.py compute the errors.
"""
