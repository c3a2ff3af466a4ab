"""Every example runs, ends well by its own check, and is what its page shows."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path

import pytest
from plugged import forget_label

from blinkgl.tools import example_docs

REPOSITORY = Path(__file__).resolve().parents[1]
EXAMPLES = REPOSITORY / "examples"
PAGE = (REPOSITORY / "docs/examples.md").read_text(encoding="utf-8")
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


def test_all_are_on_the_page():
    assert set(NAMES) == set(example_docs.ORDER)
    assert PAGE.startswith(example_docs.HEADER)
    assert re.findall(r"^## (\w+)$", PAGE, re.M) == list(example_docs.ORDER)
    for _, picture, _ in example_docs.PICTURES.values():
        assert (REPOSITORY / "docs/images" / picture).is_file()


@pytest.mark.parametrize("name", NAMES)
def test_example(name, tmp_path):
    if "torch" in (EXAMPLES / f"{name}.py").read_text():
        pytest.importorskip("torch")
    output = example_docs.run(name, tmp_path / "made here", EXAMPLES)
    if name == "own_label":
        forget_label("position")
    assert 1 <= len(output.splitlines()) <= 8
    shown = example_docs.section(name, output, EXAMPLES)
    text = PAGE[PAGE.index(f"## {name}\n") :]
    text = text[: text.find("\n## ", 1) + 1 or None]
    assert shown.partition("\n```\n\n```\n")[0] == text.partition("\n```\n\n```\n")[0], (
        "run: python -m blinkgl.tools.example_docs"
    )
    assert example_docs.without_numbers(shown) == example_docs.without_numbers(text), (
        "run: python -m blinkgl.tools.example_docs"
    )


@pytest.mark.parametrize(
    ("book_of", "said"),
    [
        ("demo", "events per pixel"),
        pytest.param("flow", "error, of zero flow's", marks=pytest.mark.slow),  # it trains for half a minute
    ],
)
def test_notebook(monkeypatch, capsys, book_of, said):
    if book_of == "flow":
        pytest.importorskip("torch")
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    path = EXAMPLES / f"{book_of}.ipynb"
    book = json.loads(path.read_text(encoding="utf-8"))
    assert book["nbformat"] == 4 and all({"cell_type", "metadata", "source"} <= set(cell) for cell in book["cells"])
    assert all(cell["outputs"] == [] for cell in book["cells"] if cell["cell_type"] == "code"), "saved with outputs"
    monkeypatch.chdir(REPOSITORY)
    names: dict = {}
    for number, cell in enumerate(example_docs.cells(path)):
        exec(compile(cell, f"{path.name}, code cell {number}", "exec"), names)
    plt.close("all")
    assert said in capsys.readouterr().out


def test_what_notebooks_import_is_there():
    """Also where nobody runs the slow one."""
    pytest.importorskip("torch")
    code = "\n".join(cell for path in EXAMPLES.glob("*.ipynb") for cell in example_docs.cells(path))
    named = re.findall(r"^from ((?:blinkgl|eflow)\S*) import (.+)$", code, re.M)
    assert len(named) >= 4
    for module, names in named:
        assert not [name for name in names.split(", ") if not hasattr(importlib.import_module(module), name)]


def test_readme_hello_world(tmp_path, monkeypatch):
    """The first Python of the README runs as it stands, in ten lines."""
    block = re.search(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text(encoding="utf-8"), re.S)[1]
    assert len(block.strip().splitlines()) <= 10
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(block, "README.md", "exec"), names)
    assert len(names["events"]) > 1000 and names["flow"].shape[-1] == 2
