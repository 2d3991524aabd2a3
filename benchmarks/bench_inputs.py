"""What do checking and planning a survey of a thousand photographs of 20 megapixels take, in seconds and memory?

    python benchmarks/bench_inputs.py [--images N] [--kind poses|gps] [--suffix jpg|tif|png] [-o FOLDER]

Draws one photograph of 5472 x 3648 pixels, writes it N times with a GPS position of its own, as a block of parallel
strips, and runs `bathynerf check` on the folder in a process of its own. Photographs of a camera are larger, but only
their heads and ends are read; a TIFF has 60 MB here. Prints one JSON: seconds, peak of memory, number of cores.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from pyproj import Transformer

ROOT = Path(__file__).resolve().parent.parent
SIZE, FOCAL_PX = (5472, 3648), 3666.0
E0, N0, LEVEL = 589012.0, 5194736.0, 2105.0
FLYING_M, BASE_M, BETWEEN_STRIPS_M = 40.0, 8.0, 18.0
TOML = """
name = "thousand"
crs = "EPSG:25832+5778"
[cameras]
{poses}
model = "PINHOLE"
size_px = [5472, 3648]
focal_px = 3666.0
[water]
level_m = 2105.0
refractive_index = 1.333
"""


def positions(num: int) -> np.ndarray:
    """Easting, northing, height (N, 3) of photographs along parallel strips of about as many as there are strips."""
    along = math.ceil(math.sqrt(num * BETWEEN_STRIPS_M / BASE_M))
    strip, place = np.divmod(np.arange(num), along)
    return np.column_stack([E0 + BASE_M * place, N0 + BETWEEN_STRIPS_M * strip, np.full(num, LEVEL + FLYING_M)])


def write_folder(folder: Path, num: int, kind: str, suffix: str) -> None:
    """A survey folder with poses in cameras.csv, or with GPS positions alone."""
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(7)
    small = rng.integers(0, 255, (SIZE[1] // 64, SIZE[0] // 64, 3), dtype=np.uint8)
    image = Image.fromarray(small).resize(SIZE, Image.Resampling.BICUBIC)
    options = {"jpg": {"quality": 60}, "tif": {}, "png": {"compress_level": 1}}[suffix]
    lonlat = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
    places, first, lines = positions(num), b"", ["image,easting,northing,height,omega,phi,kappa"]
    for i, (east, north, height) in enumerate(places):
        path = images / f"DJI_{i:04d}.{suffix}"
        lon, lat = lonlat.transform(east, north)
        exif = Image.Exif()
        exif[ExifTags.Base.Make] = "maker"
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(
            {1: "N", 2: (lat, 0.0, 0.0), 3: "E", 4: (lon, 0.0, 0.0), 5: b"\0", 6: height}
        )
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 24
        for ifd in (ExifTags.IFD.GPSInfo, ExifTags.IFD.Exif):
            exif[ifd] = 0  # Pillow writes those that are named into a TIFF
        if suffix == "jpg":
            # The pixels are compressed once; only the segment with the position differs.
            if not first:
                image.save(path, **options)
                first = path.read_bytes()
            block = b"Exif\0\0" + exif.tobytes().removeprefix(b"Exif\0\0")
            segment = b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block
            path.write_bytes(first[:2] + segment + first[2:])
        else:
            image.save(path, exif=exif, **options)
        lines.append(f"{path.name},{east:.3f},{north:.3f},{height:.3f},0,0,0")
    if kind == "poses":
        (folder / "cameras.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    poses = 'poses = "cameras.csv"' if kind == "poses" else ""
    (folder / "survey.toml").write_text(TOML.format(poses=poses), encoding="utf-8")


def measure(folder: Path) -> dict[str, float | int]:
    """Seconds and peak memory of `bathynerf check` on a folder."""
    command = [sys.executable, "-c", "from survey.commands.app import main; main()", "check", str(folder)]
    began = time.perf_counter()
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, check=False)
    seconds = time.perf_counter() - began
    if done.returncode != 0:
        sys.exit(f"check ended with {done.returncode}")
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    return {"seconds": round(seconds, 1), "peak_gb": round(peak / 1e9, 2), "cores": len(os.sched_getaffinity(0))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=1000)
    parser.add_argument("--kind", choices=("poses", "gps"), default="poses")
    parser.add_argument("--suffix", choices=("jpg", "tif", "png"), default="jpg")
    parser.add_argument("-o", "--output", type=Path, help="keep the folder here")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = asked.output or Path(temporary)
        write_folder(folder, asked.images, asked.kind, asked.suffix)
        result = {"images": asked.images, "kind": asked.kind, "suffix": asked.suffix, **measure(folder)}
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
