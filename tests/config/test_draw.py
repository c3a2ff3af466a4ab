"""Per-sequence parameter distributions."""

import numpy as np
import pytest
from scipy import stats

from blinkgl.config.draw import draw, sites
from blinkgl.errors import ConfigError

TREE = {"a": {"uniform": [0.18, 0.25]}, "b": {"c": [{"integer": [1, 6]}, 5]}, "d": {"choice": ["x", "y"]}, "e": 3}


def test_same_seed_and_sequence_same_draw_and_others_differ():
    assert draw(TREE, 0, 3) == draw(TREE, 0, 3)
    assert draw(TREE, 0, 3)["a"] != draw(TREE, 0, 4)["a"] != draw(TREE, 1, 4)["a"]


def test_a_new_distribution_moves_no_other_draw():
    more = {"new": {"uniform": [0, 1]}, **TREE}
    assert draw(more, 5, 2)["a"] == draw(TREE, 5, 2)["a"]


def test_uniform_over_sequences_is_uniform():
    values = [draw({"a": {"uniform": [2, 4]}}, 0, i)["a"] for i in range(2000)]
    assert stats.kstest(values, "uniform", args=(2, 2)).pvalue > 1e-3


def test_log_uniform_is_uniform_in_log():
    values = np.log10([draw({"a": {"log_uniform": ["1e-4", 1e-2]}}, 0, i)["a"] for i in range(2000)])
    assert stats.kstest(values, "uniform", args=(-4, 2)).pvalue > 1e-3


def test_weighted_choice_follows_its_weights():
    values = [draw({"a": {"weighted": {"esim": 3, "v2e": 1}}}, 0, i)["a"] for i in range(2000)]
    share = values.count("esim")
    assert stats.binomtest(share, 2000, 0.75).pvalue > 1e-3 and set(values) == {"esim", "v2e"}


def test_integer_includes_both_ends_and_is_flat():
    values = [draw({"a": {"integer": [1, 4]}}, 0, i)["a"] for i in range(2000)]
    assert set(values) == {1, 2, 3, 4}
    assert stats.chisquare([values.count(k) for k in range(1, 5)]).pvalue > 1e-3


@pytest.mark.parametrize(
    "node, message",
    [
        ({"uniform": [2, 1]}, "p.q.uniform: not a range"),
        ({"uniform": [1]}, "p.q.uniform: not a range"),
        ({"uniform": "ab"}, "p.q.uniform: not a range"),
        ({"uniform": [-1e308, 1e308]}, "p.q.uniform: not a range"),
        ({"integer": [0, 10**19]}, "p.q.integer: not a range of whole numbers"),
        ({"uniform": [0, 10**400]}, "p.q.uniform: not a range"),
        ({"uniform": [0, "nan"]}, "p.q.uniform: not a range"),
        ({"log_uniform": [0, 1]}, "p.q.log_uniform: not a logarithmic range"),
        ({"integer": [1, 2.5]}, "p.q.integer: not a range of whole numbers"),
        ({"choice": []}, "p.q.choice: not a list of choices"),
        ({"weighted": {"a": 0}}, "p.q.weighted: not a table of weights"),
        ({"weighted": {"a": -1, "b": 3}}, "p.q.weighted: not a table of weights"),
    ],
)
def test_malformed_distributions_name_the_path(node, message):
    for function in (lambda t: draw(t, 0, 0), sites):
        with pytest.raises(ConfigError, match="^" + message):
            function({"p": {"q": node}})
