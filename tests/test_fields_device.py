"""The choice of what runs the kernels, and that torch alone suffices."""

import importlib
import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fields.device import Device, choose_device
from fields.sweep.matching import kernels

ROOT = Path(__file__).resolve().parent.parent

# A whole sweep in a process where importing Dr.Jit fails.
TORCH_ALONE = """
import sys
sys.modules["drjit"] = None
from fields.sweep.bed import unique_pixels
from fields.sweep.maps import trusted
from fields.device import choose_device
from fields.sweep.matching import Pass
from fields.sweep.sweep import sweep
from fields.sweep.view_pass import SweepSettings
from plane_survey import TILTED, PlaneBed, ring

device = choose_device("torch")
block = PlaneBed(TILTED, -2.0).block(device, ring(4))
passes = (Pass(0.5, 2, None, 0.5, 4, True), Pass(1.0, 2, 5, 0.3, 4, True))
maps = sweep(block, [0, 1, 2], SweepSettings((-2.3, -1.8), passes), lambda share: None)
kept = unique_pixels(block, maps, 0.05)
assert all(trusted(m).mean() > 0.4 for m in maps)
assert 0 < sum(k.sum() for k in kept) < sum(trusted(m).sum() for m in maps)
assert sys.modules["drjit"] is None
sys.stdout.write("done on " + device.name)
"""

# Dr.Jit itself says on standard error that it does not take the library.
NO_LLVM = """
import sys
from fields.device import choose_device
for wanted in ("cpu", "auto"):
    device = choose_device(wanted)
    sys.stdout.write(f"{device.name}|{device.reason}\\n")
"""


def run(script: str, **environment: str) -> str:
    """Standard output of a script in a Python of its own."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": paths, **environment},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_an_unknown_word_is_refused():
    with pytest.raises(ValueError, match="device is 'gpu', expected auto, cpu, cuda or torch"):
        choose_device("gpu")


def test_cuda_is_refused_where_there_is_none():
    if choose_device("auto").name == "cuda":
        pytest.skip("this machine has a CUDA device")
    with pytest.raises(ValueError, match="finds no CUDA device; use --device cpu"):
        choose_device("cuda")


def test_each_device_has_its_inner_loops_and_says_why_it_was_chosen():
    for wanted in ("cpu", "torch"):
        device = choose_device(wanted)
        assert device is choose_device(wanted)
        library = "torch" if device.name == "torch" else "drjit"
        assert kernels(device).__name__ == f"fields.sweep.kernels.{library}_kernels"
        assert (device.module is None) == (device.name == "torch")
        assert device.reason
    assert choose_device("torch") == Device("torch", None, "torch was requested", choose_device("torch").place)


def parameters_of(module) -> dict[str, list[str]]:
    """Names of the parameters of each public function that a module defines."""
    public = {n: f for n, f in vars(module).items() if inspect.isfunction(f) and not n.startswith("_")}
    return {n: list(inspect.signature(f).parameters) for n, f in public.items() if f.__module__ == module.__name__}


def test_the_kernels_in_torch_have_the_functions_of_those_in_drjit():
    one, other = (importlib.import_module(f"fields.sweep.kernels.{name}_kernels") for name in ("torch", "drjit"))
    expected = parameters_of(one)
    assert len(expected) >= 8
    assert {name: list(inspect.signature(getattr(other, name)).parameters) for name in expected} == expected
    assert parameters_of(other).keys() <= expected.keys()


def test_torch_sweeps_without_dr_jit():
    assert run(TORCH_ALONE, OMP_NUM_THREADS="1") == "done on torch"


def test_without_llvm_the_cpu_falls_back_on_torch_and_names_the_library_it_was_given():
    lines = run(NO_LLVM, DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so", CUDA_VISIBLE_DEVICES="").splitlines()
    assert [line.split("|")[0] for line in lines] == ["torch", "torch"]
    assert all("/nowhere/libLLVM.so is not LLVM 17 or newer" in line and "slower" in line for line in lines)


@pytest.mark.slow
def test_an_old_llvm_that_would_end_the_process_is_not_used():
    old = sorted(Path("/usr/lib").glob("*-linux-gnu/libLLVM-1[4-6].so*"))
    if not old:
        pytest.skip("this machine has no LLVM 14 to 16")
    lines = run(NO_LLVM, DRJIT_LIBLLVM_PATH=str(old[-1]), CUDA_VISIBLE_DEVICES="").splitlines()
    assert [line.split("|")[0] for line in lines] == ["torch", "torch"]
    assert all(f"{old[-1]} is not LLVM 17 or newer" in line for line in lines)
