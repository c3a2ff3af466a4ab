"""The code of docs/extending.md runs as it stands. Parts of one's own are in test_plugins.py."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from blinkgl import EventDataError

PAGE = (Path(__file__).parents[1] / "docs/extending.md").read_text(encoding="utf-8")


@pytest.fixture
def code(tmp_path, monkeypatch):
    """The Python of a section, as a module."""

    def module(section: str) -> ModuleType:
        text = PAGE.partition(f"\n## {section}\n")[2].partition("\n## ")[0]
        path = tmp_path / "of_the_page.py"
        path.write_text(re.search(r"```python\n(.*?)```", text, re.S)[1])
        spec = importlib.util.spec_from_file_location(path.stem, path)
        made = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, path.stem, made)  # where pydantic looks up the names of annotations
        spec.loader.exec_module(made)
        return made

    return module


def test_a_network(code):
    torch = pytest.importorskip("torch")
    from eflow.metrics import sequence_loss

    made = code("A network")
    model = made.Tiny(made.TinyConfig(width=8))
    batch = {k: torch.randn(2, 5, 48, 64) for k in ("old", "new")}
    prediction = model(batch)
    assert prediction.flow.shape == (2, 2, 48, 64)
    loss = sequence_loss(prediction, torch.ones(2, 2, 48, 64), torch.ones(2, 48, 64, dtype=torch.bool))
    (loss[0] if isinstance(loss, tuple) else loss).backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in model.parameters())
    with pytest.raises(EventDataError, match="multiples of 8"):
        model({k: torch.randn(1, 5, 50, 64) for k in ("old", "new")})
