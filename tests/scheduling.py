"""Which tests share a process where there are several: those that share a simulator, compiled once."""

from __future__ import annotations

import pytest
from xdist.scheduler import LoadScopeScheduling

__all__ = ["group", "pytest_xdist_make_scheduler"]

TOGETHER = ("tests/verification/",)
"""Folders whose files share a simulator."""

ALONE = ("tests/test_cuda.py", "tests/test_deterministic.py")
"""Files whose tests make simulators of their own, and take a minute each."""


def group(nodeid: str) -> str:
    """Return what a test shares its process with: its file, its folder where files share a simulator, or
    nothing but itself."""
    file = nodeid.partition("::")[0]
    if file in ALONE:
        return nodeid
    return next((folder for folder in TOGETHER if file.startswith(folder)), file)


class Grouped(LoadScopeScheduling):
    """Hands out groups, one after the other, to the processes that come to have little to do."""

    def _split_scope(self, nodeid: str) -> str:
        return group(nodeid)


@pytest.hookimpl(optionalhook=True, tryfirst=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> Grouped:
    """Give xdist this way to share out tests, whatever its ``--dist``.

    Its own ``loadgroup`` hands over groups in a part of the tests' names that pytest 9.2 no longer takes.
    """
    return Grouped(config, log)
