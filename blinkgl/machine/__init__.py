"""The machine that BlinkGL runs on.

In:    nothing.
Out:   what it can do, what is missing and the command that mends it, how long kernels have compiled.
Start: doctor.py (``examine``); cpu.py, extras.py, compiling.py, bench.py and interrupts.py answer one question each,
for every other room.
"""
