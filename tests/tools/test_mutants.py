"""The list of wrong lines fits the code; `python -m blinkgl.tools.mutants` runs the tests against each of them."""

from blinkgl.tools import mutants


def test_every_wrong_line_can_be_put_in():
    listed = mutants.mutants()
    assert len(listed) == 60
    for file, there, instead, tests in listed:
        assert there != instead and tests, file
