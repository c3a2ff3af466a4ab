"""The pages of keys say what the models say, the page of commands what the commands say."""

from pathlib import Path

import pytest

from blinkgl.tools import command_docs
from blinkgl.tools.config_docs import eflow_page, page

PAGES = {
    "docs/configuration.md": (page, "python -m blinkgl.tools.config_docs"),
    "docs/eflow_configuration.md": (eflow_page, "python -m blinkgl.tools.config_docs eflow"),
    "docs/commands.md": (command_docs.page, "python -m blinkgl.tools.command_docs"),
}


@pytest.mark.parametrize("name", PAGES)
def test_the_page_is_up_to_date(name):
    made, command = PAGES[name]
    written = (Path(__file__).parents[2] / name).read_text()
    assert written == made(), f"run: {command} > {name}"
