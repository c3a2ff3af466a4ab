"""The same configuration and seed draw the same textures, bodies, worlds and noise in every version: against
``tests/golden/draws.json``."""

from __future__ import annotations

import pytest

from blinkgl.tools import draws


@pytest.mark.parametrize("part", draws.PARTS, ids=lambda part: part.__name__)
def test_what_seeds_draw(part):
    """After a change that is meant: ``python -m blinkgl.tools.draws``, and a look at what has become of the file."""
    golden = {key: value for key, value in draws.known().items() if key.startswith(part.__name__ + "/")}
    assert golden and draws.differences(golden, draws.drawn((part,))) == []
