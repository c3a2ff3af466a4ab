"""Output of the commands. Nothing here computes a result, and no other room prints.

In:    a command's options.
Out:   one library call behind a display, text and tables for users, the command's exit status.
Start: generate.py; one module per command, with the same name and a function ``run``. Others use doctor.py to examine
the machine.
"""
