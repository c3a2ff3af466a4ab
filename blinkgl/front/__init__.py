"""The public Python interface: the functions and classes behind ``import blinkgl`` (``blinkgl/__init__.py`` has the
table of names).

In:    plain Python values; every argument is checked by name.
Out:   the data classes and configurations that a YAML file gives, and the results of the rooms.
Start: scenes.py; runs.py, drawing.py, files.py and sensors.py call one kind of room each.
"""
