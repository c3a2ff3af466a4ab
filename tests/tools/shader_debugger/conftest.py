from __future__ import annotations

import pytest
from debugger_scene import copy_shaders, write_config

from blinkgl import cli


@pytest.fixture(scope="session")
def config(tmp_path_factory) -> str:
    return write_config(tmp_path_factory.mktemp("debugger"))


@pytest.fixture
def shaders(tmp_path):
    return copy_shaders(tmp_path)


@pytest.fixture
def shader(capsys):
    """``shader("diff", …)`` runs ``blinkgl shader diff …``; returns status, stdout, stderr."""

    def run(*arguments: object) -> tuple[int, str, str]:
        status = cli.run(["shader", *map(str, arguments)])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run
