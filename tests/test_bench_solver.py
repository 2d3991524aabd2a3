import re
import sys
from importlib import import_module
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
from bench_solver import PLAIN, row


def test_rows_give_one_seed_plainly_and_several_with_the_least_and_the_greatest():
    assert row([[0.1, 6.6, 10.8, 99.8, 96.4]]) == "0.1 mm | 6.6 mm | 10.8 mm | 99.80 % | 96.40 %"
    assert row([[0.1, 6.0, 10.0, 99.8, 96.0], [0.1, 7.0, 12.0, 99.8, 97.0]]).endswith("| 96.50 % (96.00 to 97.00)")


@pytest.mark.parametrize("name", re.findall(r'patch\(\s*"([^"]+)"', PLAIN))
def test_what_the_plain_solver_leaves_out_is_there(name):
    module, _, function = name.rpartition(".")
    assert callable(getattr(import_module(module), function))


def test_the_plain_solver_leaves_out_the_prior_and_the_heights_of_the_sweep():
    assert len(re.findall(r'patch\(\s*"', PLAIN)) == 2
