"""Fixtures shared by all tests: fixed seeds, the folder of external surveys, and what several files build alike."""

import gc
import os
import sys
from pathlib import Path

# Before NumPy is loaded: threads of BLAS wait for each other longer than they compute on matrices as small as those of
# tests, above all where other programs want the cores too.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# `make test` has a process for each core.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pytest
from surface_rays import llvm

# What is imported and collected stays to the end: walks of the garbage collector through it would find nothing, in the
# collection and between tests.
gc.disable()


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """From here on the garbage collector runs as in any program, over what tests make."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Torch draws alike in each test, whatever ran before it; left alone it has another seed in every process.

    It is not imported for this: that takes seconds, in the process that starts the workers, too.
    """
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(20260101)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260101)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The external surveys: $BATHYNERF_DATA, else ../shared/data beside the repository, else skip."""
    root = Path(__file__).resolve().parent.parent
    folder = Path(os.environ.get("BATHYNERF_DATA", root.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no survey data at {folder}; set BATHYNERF_DATA to the folder that has it")
    return folder


@pytest.fixture(scope="session", params=["cpu", "torch", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request):
    """Each device that the kernels of `fields` run on: Dr.Jit on LLVM (skipped without), torch, Dr.Jit on CUDA."""
    from fields.device import choose_device

    chosen = choose_device(request.param)
    if request.param == "cpu" and chosen.name != "llvm":
        pytest.skip(f"Dr.Jit does not run on this CPU: {chosen.reason}")
    return chosen


@pytest.fixture(scope="session")
def Float():
    """Dr.Jit floats on LLVM, differentiable."""
    return llvm().Float


@pytest.fixture(scope="session")
def shallow_survey(tmp_path_factory):
    """The survey of `small_report`, loaded."""
    from small_report import load_shallow_survey

    return load_shallow_survey(tmp_path_factory.mktemp("survey"))


@pytest.fixture(scope="session")
def plane_report(shallow_survey, tmp_path_factory):
    """The finished report of `small_report`: its run, facts, figures and number of steps; for tests that only read."""
    from small_report import write_plane_report

    return write_plane_report(shallow_survey, tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="session")
def shore_drawing():
    """The scene of `drawn_shore`, staged."""
    from drawn_shore import SHORE

    from survey.simulate.drawn import stage_drawing

    return stage_drawing(SHORE)


@pytest.fixture(scope="session")
def shore_folder(tmp_path_factory) -> Path:
    """The survey of `drawn_shore`, drawn; for tests that only read."""
    from drawn_shore import SHORE

    from survey.simulate.drawn import draw_survey

    path = tmp_path_factory.mktemp("drawn") / "shore"
    draw_survey(path, SHORE)
    return path


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """The bed of `stored_run.plane_stored`."""
    from stored_run import plane_stored

    return plane_stored(tmp_path_factory.mktemp("survey") / "small")


@pytest.fixture(scope="module")
def run_folder(stored, tmp_path_factory) -> Path:
    """The folder of a run whose result is that bed."""
    from stored_run import run_of

    return run_of(stored, tmp_path_factory.mktemp("run") / "run")
