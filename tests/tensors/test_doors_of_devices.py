"""A device that is not there is one line of the program's own, whatever torch says."""

import pytest

import blinkgl

torch = pytest.importorskip("torch")


@pytest.mark.parametrize("emulator", ["TensorEsim", "TensorV2e"])
@pytest.mark.parametrize("device", ["gpu", "cuda:99", "xpu", "", 3.5])
def test_a_device_that_is_not_there_is_one_line(emulator, device):
    with pytest.raises(blinkgl.BlinkGLError, match=r"device: there is no such device .* expected cpu") as error:
        getattr(blinkgl, emulator)(20, 30, envs=2, device=device)
    assert len(str(error.value).splitlines()) == 1
