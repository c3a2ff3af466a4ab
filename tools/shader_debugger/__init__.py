"""The shader debugger: ``blinkgl shader passes | probe | diff | check | show | serve``.

In:    a configuration, a time in one of its sequences, a folder of shaders.
Out:   the buffers of all passes beside those of a float64 reference, as pictures, text and a page.
Start: cli.py (the commands), then session.py:

    session.py    the scene of a generation run at one time; the shader folder; the OpenGL context
    moments.py    every buffer at that time, from the GPU and from the float64 reference, by the same names
    filters.py      float64 references of pictures made from pictures: `edges`, and the image of a lens
    lamps.py      shadow maps in float64 and their tolerance; soft shadows
    quantities.py the error measure and the tolerance of each buffer
    compare.py    comparison of the two, and the pixels that differ
    suspicions.py likely causes of an error
    probe.py      everything about one pixel
    picture.py    arrays as pictures: colour maps, labelled PNGs, the contact sheet
    check.py      compiles every program in every variant; errors at their source line (diagnostics.py)
    server.py     serves the page (page/); inspector.py answers its requests
    cli.py        the commands

Production code never imports this package. ``shaders/debug.glsl`` is compiled only for it.
"""
