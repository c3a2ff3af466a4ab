"""Programs of the developers: benchmarks, fuzzers, generated pages, the shader debugger.

In:    the repository, the package as anybody would use it.
Out:   figures, pages, exit statuses.
Start: fingerprint.py (did a change change any byte?), bench.py, shader_debugger/.
"""
