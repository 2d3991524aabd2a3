"""A scene file of a small flight over a level bed, for tests to change, and meshes for its beds and objects."""

from pathlib import Path

import numpy as np

from survey.simulate.scene_file import read_scene
from survey.simulate.simulate import plan_scene, stage_scene

SCENE = """
crs = "EPSG:25832+7837"
origin = [676120.0, 5311480.0, 584.2]
[area]
size_m = [2.4, 2.0]
[bed]
kind = "plane"
depth_m = 1.2
[texture]
texel_m = 0.02
[water]
slope_north = 0.003
[camera]
size_px = [96, 72]
focal_px = 160.0
[flight]
height_m = 6.0
patterns = ["nadir"]
forward_overlap = 0.6
side_overlap = 0.5
[sensor]
noise = 0.0
[render]
mode = "direct"
"""


def scene_file(folder: Path, text: str = SCENE, **changes: str) -> Path:
    """A scene file; changes replace whole lines by what they begin with, or whole tables."""
    for start, line in changes.items():
        lines = text.splitlines()
        hit = [k for k, old in enumerate(lines) if old.startswith(start)]
        assert hit, start
        lines[hit[0]] = line
        text = "\n".join(lines)
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


def staged(path: Path):
    return stage_scene(plan_scene(read_scene(path), path.parent))


def write_mesh(path: Path, vertices: np.ndarray, faces, colours=None) -> None:
    """ASCII PLY, as other programs write it."""
    rows = [f"{x} {y} {z}" for x, y, z in vertices]
    head = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property double {a}" for a in "xyz")]
    if colours is not None:
        head += [f"property uchar {name}" for name in ("red", "green", "blue")]
        rows = [f"{row} {r} {g} {b}" for row, (r, g, b) in zip(rows, colours, strict=True)]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    path.write_text("\n".join([*head, *rows, *(f"3 {a} {b} {c}" for a, b, c in faces), ""]), encoding="ascii")
