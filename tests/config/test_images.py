"""``images:`` of a configuration: presets, what contradicts, what does not fit into the sequence."""

import pytest
import yaml

from blinkgl.config.images import check_images, exposure_starts
from blinkgl.config.problems import Refused
from blinkgl.config.run import load_run
from blinkgl.dataset.report import config_yaml
from blinkgl.errors import ConfigError
from tests.refusals import refusal


def read(tmp_path, **changes):
    path = tmp_path / "run.yaml"
    path.write_text(yaml.safe_dump(changes))
    return load_run(path)


@pytest.mark.parametrize(
    ("images", "said"),
    [
        ({"exposure_us": 0}, "images.exposure_us: too small (got 0); expected a number from 1 to 1e+09"),
        ({"exposure_us": 0.5}, "images.exposure_us: too small"),
        ({"exposure_us": -5}, "images.exposure_us: too small"),
        (
            {"exposure_us": 2e6, "rate": 0.1},
            "images.exposure_us: no exposure fits into the sequence (got 2000000.0); expected at most 1.1e+06",
        ),
        (
            {"exposure_us": 40_000, "rate": 30},
            (
                "images.exposure_us: the exposure is longer than the image interval (got 40000.0); "
                "expected at most 33333.3, or a lower rate"
            ),
        ),
        ({"row_us": 200, "rate": 30}, "images.row_us: the read-out of the rows is longer than the image interval"),
        ({"row_us": 10_000, "rate": 0.1}, "images.exposure_us: no exposure fits into the sequence"),
        ({"times": [0.1, 1.2]}, "images.times: an exposure outside the sequence (got 1.2); expected from 0 to 1.095"),
        ({"times": [-0.1]}, "images.times: an exposure outside the sequence (got -0.1)"),
        ({"times": [0.2, 0.1]}, "images.times: exposure times are out of order"),
        ({"times": [0.2, 0.201]}, "images.times: exposure times are out of order, or closer"),
        ({"times": []}, "images.times: too few entries"),
        (
            {"times": [0.2, 0.3], "rate": 20},
            "images.rate: images are taken at a rate or at times (got 20.0); expected null beside images.times",
        ),
        (
            {"times": [0.2, 0.3], "rate": 24, "preset": "deblurring"},
            "images.rate: images are taken at a rate or at times (got 24.0)",
        ),
        ({"rate": None}, "images.rate: neither a rate nor times are given (got None); expected a rate"),
        (
            {"times": [0.2, 0.21], "row_us": 100},
            "images.times: the read-out of the rows is longer than the image interval",
        ),
        ({"bits": 7}, "images.bits: too small (got 7); expected a whole number from 8 to 16"),
        ({"bits": 17}, "images.bits: too large"),
        ({"response": "log"}, "images.response: unknown choice (got 'log')"),
        ({"gamma": 1.8}, "images.gamma: gamma needs `response: gamma` (got 1.8); expected response: gamma"),
        ({"bayer": "rgbg"}, "images.bayer: unknown choice"),
        ({"also": ["sharp", "sharp"]}, "images.also: given twice"),
        ({"lens": {"aperture": 0.1}}, "images.lens.focus: is required"),
        ({"lens": {"aperture": 0.1, "focus": 0}}, "images.lens.focus: too small"),
        ({"preset": "night"}, "images.preset: unknown choice (got 'night')"),
        ({"exposure": 5}, "images.exposure: unknown key; expected 'exposure_us' (nearest)"),
        (
            {"auto_exposure": {"longest_us": 1000}},
            (
                "images.exposure_us: the first exposure is outside the limits of auto_exposure (got 5000.0); "
                "expected from 20 to 1000 (auto_exposure)"
            ),
        ),
        (
            {"auto_exposure": {"longest_us": 40_000}},
            "images.auto_exposure.longest_us: the exposure is longer than the image interval (got 40000.0)",
        ),
        (
            {"auto_exposure": {"longest_us": 5}},
            "images.auto_exposure.longest_us: too small (got 5); expected a number fr",
        ),
        ({"auto_exposure": {}, "gain_db": 30}, "images.gain_db: the first gain is above the limit of auto_exposure"),
    ],
)
def test_what_cannot_be_is_one_line(tmp_path, images, said):
    assert refusal(ConfigError, read, tmp_path, images=images).startswith(said)


@pytest.mark.parametrize("preset", ["plain", "interpolation"])
def test_times_take_the_place_of_a_rate(tmp_path, preset):
    """Also of a preset's; and what is written down is read again."""
    config = read(tmp_path, images={"preset": preset, "times": [0.1, 0.4]}).sequence(0)
    assert config.images.rate is None and config.images.times == (0.1, 0.4)
    again = tmp_path / "again.yaml"
    again.write_text(config_yaml(config, 0))
    assert load_run(again).sequence(0).images == config.images


@pytest.mark.parametrize("exposure_us", [249, 100_003, 199_999])
def test_an_exposure_as_long_as_the_sequence_fits(exposure_us):
    check_images(None, None, float(exposure_us), 0.0, 0.0, exposure_us * 1e-6)
    check_images(1e-3, None, float(exposure_us), 0.0, 0.0, exposure_us * 1e-6)
    with pytest.raises(Refused, match="no exposure fits"):
        check_images(1e-3, None, float(exposure_us), 0.0, 0.0, (exposure_us - 1) * 1e-6)


def test_no_exposure_starts_where_none_fits(tmp_path):
    """Of a window shorter than an exposure, and of times outside a window."""
    images = read(tmp_path, images={"rate": 30, "exposure_us": 20_000}).sequence(0).images
    count = lambda span_ms: len(exposure_starts(images, 0, round(span_ms * 1e6), 1))
    assert [count(ms) for ms in (0, 10, 19.999, 20, 53.3, 53.4)] == [0, 0, 0, 1, 1, 2]
    listed = read(tmp_path, images={"times": [0.1, 0.2], "exposure_us": 20_000}).sequence(0).images
    starts = lambda a, b: exposure_starts(listed, round(a * 1e9), round(b * 1e9), 1)
    assert starts(0, 1) == [10**8, 2 * 10**8] and starts(0.15, 1) == [2 * 10**8] and starts(0, 0.21) == [10**8]
    assert starts(0.1, 0.12) == [10**8] and starts(0.101, 0.119) == []
