"""Runs of these tests count as one build, although somebody may be editing the code while they are on."""

import os

import pytest


@pytest.fixture(scope="session", autouse=True)
def one_build():
    os.environ["BLINKGL_BUILD"] = "tests"
    yield
    os.environ.pop("BLINKGL_BUILD")
