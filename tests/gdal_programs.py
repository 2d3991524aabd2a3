"""GDAL's own programs, where they are installed: readers that share no process with what writes."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

needs_gdal = pytest.mark.skipif(
    shutil.which("gdalinfo") is None, reason="GDAL's programs are not installed (Debian: apt-get install gdal-bin)"
)


def gdalinfo(path: Path) -> dict:
    """What gdalinfo says of a raster."""
    text = subprocess.run(["gdalinfo", "-json", path], capture_output=True, check=True, text=True).stdout
    return json.loads(text)
