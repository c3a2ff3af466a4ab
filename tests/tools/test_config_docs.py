"""docs/configuration.md says what the models say."""

from pathlib import Path

from blinkgl.tools.config_docs import page


def test_the_page_is_up_to_date():
    written = (Path(__file__).parents[2] / "docs/configuration.md").read_text()
    assert written == page(), "run: python -m blinkgl.tools.config_docs > docs/configuration.md"


def test_every_key_is_explained():
    rows = [line for line in page().splitlines() if line.startswith("| `")]
    silent = [row for row in rows if row.rstrip(" |").endswith("|") or row.split("|")[-2].strip() == ""]
    assert [r for r in silent if not r.startswith(("| `kind`", "| `emulator`", "| `category`"))] == []
