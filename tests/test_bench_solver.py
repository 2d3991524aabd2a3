"""The benchmark of the solver beside other ways: its rows, and what the plain Gauss-Newton leaves out."""

from __future__ import annotations

import re
from importlib import import_module

import bench_solver as bench


def test_what_the_plain_gauss_newton_leaves_out_is_there():
    names = re.findall(r'patch\(\s*"([^"]+)"', bench.PLAIN)
    assert len(names) == 2
    for name in names:
        module, _, function = name.rpartition(".")
        assert callable(getattr(import_module(module), function))
