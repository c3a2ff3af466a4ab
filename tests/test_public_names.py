"""Public names and signatures, as tests/golden/public_names.txt keeps them: what a release promises.

``BLINKGL_UPDATE_GOLDEN=1 python -m pytest tests/test_public_names.py`` writes the file anew. A line that goes or
changes is a deprecation (CONTRIBUTING.md), not a correction of this file.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from pinned import only_with_pinned

import blinkgl

GOLDEN = Path(__file__).parent / "golden" / "public_names.txt"


def signature(of: object) -> str:
    """The signature without addresses; "" where there is none."""
    try:
        return str(inspect.signature(of)).replace("'", '"')
    except (TypeError, ValueError):
        return ""


def lines() -> Iterator[str]:
    for name in sorted(blinkgl.__all__):
        thing = getattr(blinkgl, name)
        if not inspect.isclass(thing):
            yield f"{name}{signature(thing)}"
            continue
        yield f"class {name}{signature(thing)}"
        for key, part in sorted(vars(thing).items()):
            if key.startswith("_"):
                continue
            if isinstance(part, (staticmethod, classmethod)):
                yield f"    {name}.{key}{signature(getattr(thing, key))}"
            elif inspect.isfunction(part):
                yield f"    {name}.{key}{signature(part)}"
            else:
                yield f"    {name}.{key}"


def test_public_names_and_signatures_are_those_that_are_kept():
    pytest.importorskip("torch", reason="TensorEsim and others are loaded with it")
    only_with_pinned("numpy", "pydantic")
    text = "\n".join(lines()) + "\n"
    if os.environ.get("BLINKGL_UPDATE_GOLDEN"):
        GOLDEN.write_text(text, encoding="utf-8")
    kept = GOLDEN.read_text(encoding="utf-8").splitlines()
    gone = [line for line in kept if line not in text.splitlines()]
    new = [line for line in text.splitlines() if line not in kept]
    assert not gone and not new, "\n".join([*(f"- {line}" for line in gone), *(f"+ {line}" for line in new)])
