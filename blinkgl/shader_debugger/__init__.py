"""The shader debugger: ``blinkgl shader passes | probe | diff | check | show | serve``.

In:    a configuration, a moment of one of its sequences, a folder of shaders.
Out:   what every pass wrote there beside what a float64 reference says, as pictures, words and a page.
Start: cli.py (the commands), then session.py:

    session.py    one moment of the scene that a generation run would render; the shader folder; the OpenGL side
    moments.py    every buffer of that moment, from the GPU and from the float64 reference, by the same names
    twins.py      pictures made of pictures: what `edges` puts together and what a lens sees
    lamps.py      shadow maps in float64, and where they may be off; soft shadows
    quantities.py how each buffer is graded, and with which tolerance
    compare.py    one against the other, at which pixels
    suspicions.py what the error looks like
    probe.py      everything about one pixel
    picture.py    arrays as pictures: colour maps, labelled PNGs, the contact sheet
    check.py      every program in every variant, errors at their own line (diagnostics.py)
    server.py     the page (page/); inspector.py: what it may ask, and the answers
    cli.py        the commands

Production code never imports this package, and ``shaders/debug.glsl`` is compiled only when it asks.
"""
