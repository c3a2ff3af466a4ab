"""The front door: what ``import blinkgl`` gives a person in Python (``blinkgl/__init__.py`` has the table of names).

In:    plain Python values, every argument checked by name.
Out:   the data classes and configurations that a YAML file becomes, and what the rooms make of them.
Start: scenes.py; runs.py, drawing.py, files.py and sensors.py call one kind of room each.
"""
