"""What the commands print. Nothing here makes a result, and no other room prints.

In:    a command's options.
Out:   one call into the library behind a display, words and tables for people, the command's exit status.
Start: generate.py; one module per command, of its name, with ``run``. doctor.py also examines the machine for others.
"""
