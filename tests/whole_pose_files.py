"""The files of a small survey in each format of poses, as other programs write them."""

import json
from pathlib import Path

import pycolmap
from foreign_block import draw_block
from test_pose_files_metashape import cameras_xml
from test_pose_files_nerfstudio import transforms
from test_pose_files_opensfm import REFERENCE, block_json, tracks_csv
from test_pose_files_pix4d import CAMERAS, EXTERNAL
from test_pose_files_pix4d import write as write_pix4d
from test_pose_files_tables import metashape_opk, opk_deg, rows, table

NAMES = (
    "Pix4D", "Pix4D without positions", "COLMAP text", "COLMAP binary", "OpenSfM", "Metashape", "nerfstudio", "lines",
    "table",
)  # fmt: skip


def whole_pose_files(folder: Path) -> dict[str, tuple[dict[str, bytes], str]]:
    """The files of a survey in each format by their names, and which of these is given; ``folder`` is filled."""
    block = draw_block()
    write_pix4d(folder, block)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 2, 5
    options.num_points2D_without_point3D = 1
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    (folder / "text").mkdir()
    (folder / "binary").mkdir()
    model.write_text(folder / "text")
    model.write_binary(folder / "binary")

    def files(place) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in sorted(place.iterdir()) if path.is_file()}

    opensfm = {
        "reconstruction.json": json.dumps([block_json(block, reference_lla=REFERENCE)]).encode(),
        "tracks.csv": tracks_csv(block).encode(),
        "reference_lla.json": json.dumps(REFERENCE).encode(),
    }
    header = "image;easting;northing;height;omega;phi;kappa"
    return {
        "Pix4D": (files(folder), EXTERNAL),
        "Pix4D without positions": ({n: t for n, t in files(folder).items() if n != EXTERNAL}, CAMERAS),
        "COLMAP text": (files(folder / "text"), "."),
        "COLMAP binary": (files(folder / "binary"), "."),
        "OpenSfM": (opensfm, "reconstruction.json"),
        "Metashape": ({"cameras.xml": cameras_xml(block).encode()}, "cameras.xml"),
        "nerfstudio": ({"transforms.json": json.dumps(transforms(block)).encode()}, "transforms.json"),
        "lines": ({"cameras.txt": metashape_opk(block).encode()}, "cameras.txt"),
        "table": ({"cameras.csv": table(header, rows(block, opk_deg), ";", ",").encode()}, "cameras.csv"),
    }
