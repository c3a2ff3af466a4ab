"""Docstrings as the documentation site shows them."""

import pytest

pytest.importorskip("griffe", reason="the extra [docs] is not installed")

from blinkgl.tools.docstrings import markdown


@pytest.mark.parametrize(
    ("written", "shown"),
    [
        (
            "Draws :func:`~blinkgl.a.b` or :class:`Pose`, see :mod:`blinkgl.io`.",
            "Draws `b` or `Pose`, see `blinkgl.io`.",
        ),
        (
            "A pose.\n\nposition : (3,) m.   euler : (3,) degrees. quaternion : (4,)\nw, x, y, z.\nRaises ConfigError.",
            (
                "A pose.\n\n\n- **position**: (3,) m.\n- **euler**: (3,) degrees.\n- **quaternion**: (4,)\n"
                "  w, x, y, z.\n\nRaises ConfigError."
            ),
        ),
        (
            (
                "A.\n\nParameters\n----------\na, b : one\n    and more.\n*rest : others\n\n"
                "Text : that is none: of it.\n\nRaises\n------\nValueError\n    never."
            ),
            (
                "A.\n\n\n**Parameters**\n\n\n- **a, b**: one\n  and more.\n- ***rest**: others\n"
                "\n\n- **Text**: that is none: of it.\n\n\n**Raises**\n\n\n- **ValueError**:\n  never."
            ),
        ),
        ("Code:\n\n    a : int = 1\n\n```\nb : int\n```", "Code:\n\n    a : int = 1\n\n```\nb : int\n```"),
        ("A room.\n\nIn:    numbers.\nOut:   :class:`Scene`.", "A room.\n\n\n- **In**: numbers.\n- **Out**: `Scene`."),
        ("One line: of text; a: b.", "One line: of text; a: b."),
    ],
)
def test_shown(written, shown):
    assert markdown(written) == shown
