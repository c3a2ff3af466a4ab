"""YAML that is shipped: recipes, sensors/, emulators/, quality/, eflow/.

In:    nothing.
Out:   text for ``blinkgl.config.reader``.
Start: demo.yaml.
"""
