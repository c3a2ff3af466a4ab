"""What shines, and its surroundings: two looks at a blurred picture against the integral over the lobe."""

from __future__ import annotations

import lobes
import numpy as np
import pytest

from blinkgl.scene.surfaces import gloss


@pytest.fixture(scope="module")
def made():
    """Surroundings that the table was not fitted by."""
    picture = lobes.surroundings(np.random.default_rng(20))
    return picture, gloss.blurred(picture)


@pytest.mark.parametrize("roughness, most", [(0.1, 0.01), (0.25, 0.015), (0.4, 0.025), (0.6, 0.02), (0.95, 0.02)])
def test_two_looks_are_the_lobe(made, roughness, most):
    """Median relative difference, at cosines and roughnesses between those of the table. One look, as surroundings were
    looked up before, is 2 to 6 % off."""
    rng, errors = np.random.default_rng(3), []
    for cosine in (0.35, 0.65, 0.9):
        n, along = lobes.facing(rng, 16)
        true = lobes.integral(made[0], n, along, cosine, roughness)
        away = cosine * n - np.sqrt(1 - cosine**2) * along
        seen = gloss.around(made[1], n, away, np.full(len(n), cosine), np.full(len(n), roughness))
        errors.append(np.abs(seen - true) / (true + 0.01))
    assert np.median(errors) < most


def test_a_lobe_along_the_normal_is_what_surroundings_are_blurred_by(made):
    """Of fewer pixels where it is wide, too."""
    n, along = lobes.facing(np.random.default_rng(4), 12)
    for k in (4, 8, gloss.LEVELS - 1):
        roughness = k / (gloss.LEVELS - 1)
        true = lobes.integral(made[0], n, along, 1.0, roughness)
        seen = gloss.mirrored(made[1], n, np.full(len(n), roughness))
        np.testing.assert_allclose(seen, true, rtol=0.01, atol=2e-3 if k > 4 else 0.02)


def test_a_mirror_looks_once():
    n, along = lobes.facing(np.random.default_rng(5), 3)
    away = 0.6 * n - 0.8 * along
    for way, roughness, _ in gloss.both(n, away, gloss.looks()[:1, 38].repeat(3, axis=0)):
        np.testing.assert_allclose(way, away, atol=1e-6)
        assert (roughness == 0).all()


def test_looks_are_shares_of_one_whole():
    cells = gloss.looks()
    assert cells.shape == (*gloss.energy().shape[:2], 5)
    assert (cells >= 0).all() and (cells[..., 4] <= 1).all() and (cells[..., [1, 3]] <= 1).all()
