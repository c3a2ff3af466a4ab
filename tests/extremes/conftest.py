"""``promise(name, measured, bound)``: asserts, and lists what was measured at the end of
``pytest -v tests/extremes``."""

from __future__ import annotations

import pytest


@pytest.fixture
def promise(request):
    """Asserts ``measured <= bound`` (a NaN fails). docs/limits.md states the bounds."""

    def check(name: str, measured: float, bound: float, unit: str = "") -> None:
        request.node.user_properties.append(("promise", (name, float(measured), float(bound), unit)))
        assert measured <= bound, f"{name}: {measured:.3g} {unit}, promised at most {bound:.3g}"

    return check


def pytest_terminal_summary(terminalreporter, config):
    if config.get_verbosity() < 1:
        return
    rows = [
        value
        for reports in terminalreporter.stats.values()
        for report in reports
        for key, value in getattr(report, "user_properties", ())
        if key == "promise" and report.when == "call"
    ]
    if rows:
        terminalreporter.section("measured against promised")
        for name, measured, bound, unit in rows:
            terminalreporter.write_line(f"{name:64s} {measured:9.2g}  <= {bound:.2g} {unit}")
