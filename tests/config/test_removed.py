"""Keys that earlier versions had: read where they say what happens anyway, refused in one line where they do not."""

from pathlib import Path

import pytest

from blinkgl.config.reader import to_yaml
from blinkgl.config.run import load_run
from blinkgl.errors import ConfigError

OLD = Path(__file__).parents[1] / "golden" / "config_0.1.0.yaml"
"""A sequence's own config.yaml as 0.1.0 wrote it (commit 348eebef), with every key that there was."""


def test_a_recorded_configuration_of_an_earlier_version_is_read(tmp_path):
    config = load_run(OLD).sequence(0)
    assert config.events.emulator == "v2e" and config.camera.width == 96
    again = tmp_path / "again.yaml"
    again.write_text(to_yaml(config.model_dump(mode="json")))
    assert load_run(again).sequence(0) == config


@pytest.mark.parametrize(
    "path, value, said",
    [
        ("render.lod.enabled", "true", "render.lod: this key was removed"),
        ("events.compat", "authors", "events.compat: this key was removed (got 'authors'); expected the key left out"),
    ],
)
def test_a_value_that_would_matter_is_refused(path, value, said):
    with pytest.raises(ConfigError) as error:
        load_run(OLD, [f"{path}={value}"])
    assert str(error.value).startswith(said) and "\n" not in str(error.value)
