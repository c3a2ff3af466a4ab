"""The program that made the table of noise sizes makes it again."""

import numpy as np
import pytest

from blinkgl.events import noise
from blinkgl.tools.noise_rates import rate_per_time_constant


@pytest.mark.parametrize(("row", "column"), [(3, 7), (5, 4)])
def test_entries_of_the_table_are_made_again(row, column):
    rate, _ = rate_per_time_constant(noise.RATE_SIZES[column], noise.RATE_K[row])
    assert np.log(rate) == pytest.approx(noise._LOG_RATE[row, column], abs=1e-4)
