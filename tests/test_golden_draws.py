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


def test_what_counts_as_a_difference():
    assert draws.differences({"a": [1.0, 2.0]}, {"a": [1.0 + 1e-7, 2.0]}) == []
    assert draws.differences({"a": [1.0, 0.0]}, {"a": [1.0, 1e-10]}) == []
    assert draws.differences({"a": [1.0, 2.0]}, {"a": [1.0, 2.00001]}) == ["/a: [1.0, 2.0] became [1.0, 2.00001]"]
    assert draws.differences({"a": [1, 2]}, {"a": [1, 3]}) and draws.differences({"a": [1.0]}, {"a": [1.0, 2.0]})
    assert draws.differences({"a": {"log": ["x"]}}, {"a": {"log": ["y"]}}) == ["/a/log: ['x'] became ['y']"]
    assert draws.differences({"a": 1.0}, {"b": 1.0}) == [": 'a', 'b' only in one of them"]
