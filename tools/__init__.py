"""Programs of the developers: benchmarks, a fuzzer, generated pages, golden files.

In:    the repository, the package as anybody would use it.
Out:   figures, pages, exit statuses.
Start: fingerprint.py (did a change change any byte?), bench.py, fuzz.py.
"""
