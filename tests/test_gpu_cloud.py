"""A CUDA device gives the cloud that the processor gives, but for rounding; and how long both take, for who looks."""

import sys
import time

import numpy as np
import pytest
from drawn_runs import GSD, SMALL
from scipy.spatial import KDTree

from geo import read_cloud
from survey.run.process import process
from survey.simulate.drawn import DrawnScene, draw_survey

# Where two heights score alike rounding decides: of so many points none of the other cloud may be so near [GSD].
APART, NEAR_GSD = 0.01, 0.1


@pytest.mark.gpu
@pytest.mark.parametrize("quality", ["draft", "standard"])
def test_the_cloud_of_a_cuda_device_is_that_of_the_processor(tmp_path, quality):
    draw_survey(tmp_path / "survey", DrawnScene(**SMALL))
    clouds, seconds = [], []
    for device in ("cpu", "cuda"):
        start = time.monotonic()
        assert process(tmp_path / "survey", tmp_path / device, quality=quality, device=device) == 0
        seconds.append(time.monotonic() - start)
        clouds.append(read_cloud(tmp_path / device / "cloud.las").points)
    sys.stdout.write(f"{quality}: {seconds[0]:.1f} s on the processor, {seconds[1]:.1f} s on the CUDA device\n")
    assert len(clouds[1]) == pytest.approx(len(clouds[0]), rel=APART)
    for mine, other in (clouds, clouds[::-1]):
        distance, _ = KDTree(other).query(mine)
        assert np.mean(distance > NEAR_GSD * GSD) < APART
