"""A context that a driver throws away in the middle of the work: noticed, and the work done again in another one."""

from __future__ import annotations

import pytest
import yaml

from blinkgl.config.run import load_run
from blinkgl.dataset.executor import Inline
from blinkgl.dataset.run import run_dataset
from blinkgl.errors import GLError, may_pass
from blinkgl.gl import GLContext, create_context
from tests.dataset.runs import tree
from tests.tiny_recipe import TINY


class Gone:
    """A framebuffer that takes every call, and gives back what was there before."""

    use = clear = staticmethod(lambda *_: None)
    read = staticmethod(lambda components: b"\0" * components)


def test_a_context_that_draws_no_more_is_noticed(gl):
    for _ in range(300):  # each time another colour
        gl.check()
    assert not gl.lost

    with create_context() as other:
        other.idle = Gone
        said = r"^llvmpipe.*: the card has lost its context.*; expected another try, in a new context"
        with pytest.raises(GLError, match=said) as caught:
            other.check()
        assert other.lost and may_pass(caught.value)
    gl.make_current()
    gl.check()


def test_the_sequence_is_made_again_in_another_context(tmp_path, monkeypatch):
    """The first is lost when all of the first sequence has been drawn: nothing of it stays, and the files are those of
    a run without trouble."""
    recipe = tmp_path / "run.yaml"
    recipe.write_text(yaml.safe_dump({**TINY, "output": {"sequences": 2}}))
    run_dataset(load_run(recipe), tmp_path / "wanted", Inline())
    seen, check = [], GLContext.check

    def lose(self):
        seen.append(self)
        if len(seen) == 1:
            self.idle = Gone
        check(self)

    monkeypatch.setattr(GLContext, "check", lose)
    outcome = run_dataset(load_run(recipe), tmp_path / "out", Inline())
    assert len(outcome.made) == 2 and not outcome.set_aside
    assert seen[0].lost and seen[0].released and seen[1] is not seen[0] and not seen[-1].lost
    logs = "".join(path.read_text() for path in (tmp_path / "out/.run/logs").rglob("*.log"))
    assert "attempt 1 failed: llvmpipe" in logs and logs.count("\n") > 4
    assert tree(tmp_path / "out") == tree(tmp_path / "wanted")
