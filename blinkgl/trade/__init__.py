"""What accuracy costs (``blinkgl trade``).

In:    one configuration, settings to try.
Out:   their cost and error against a reference that is refined until it stands still.
Start: run.py (``trade``); measure.py times, matching.py and metrics.py judge.
"""
