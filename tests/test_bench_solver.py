"""The benchmark of the solver beside other ways: its rows, and what the plain Gauss-Newton leaves out."""

from __future__ import annotations

import re
from importlib import import_module

import bench_solver as bench


def test_rows_give_one_seed_plainly_and_several_with_the_least_and_the_greatest():
    assert bench.row([[0.1, 6.6, 10.8, 99.8, 96.4]]) == "0.1 mm | 6.6 mm | 10.8 mm | 99.80 % | 96.40 %"
    two = bench.row([[0.1, 6.0, 10.0, 99.8, 96.0], [0.1, 7.0, 12.0, 99.8, 97.0]])
    assert two.endswith("| 96.50 % (96.00 to 97.00)")


def test_what_the_plain_gauss_newton_leaves_out_is_there():
    names = re.findall(r'patch\(\s*"([^"]+)"', bench.PLAIN)
    assert len(names) == 2
    for name in names:
        module, _, function = name.rpartition(".")
        assert callable(getattr(import_module(module), function))
