"""Ground truth of a simulated survey: the mesh of its ground, and the points of it that the cameras see."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from refract import PinholeCamera
from refract.lens import Lens, distorted, normalised
from survey.simulate.ground.ground import Ground
from survey.simulate.render.direct import DirectRenderer, depth_below

# Candidates for visible points per square metre of ground.
_POINTS_PER_M2 = 1000
# A point is seen if the ray through its pixel ends this close to it [m]: far above the error of projection
# (1e-9 m, more along faces that are seen edge on), far below the distance to anything in front of it.
_SAME_POINT_M = 1e-4
# Rays flatter than this fall [-] count as seeing any distance.
_LEAST_FALL = 0.05


def ground_mesh(ground: Ground, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m], local, and faces (F, 3) of the bed and of all bodies on it.

    Parameters
    ----------
    inside : (V,) bool
        Vertices of the bed in the area that is wanted; a triangle with any of them is kept, so that the area
        is covered up to its border. Bodies are kept whole, and so is the bed beneath them.
    """
    bed, faces, _ = ground.bed.mesh()
    faces = faces[inside[faces].any(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    vertices, all_faces = [bed[used]], [faces.reshape(-1, 3)]
    count = len(used)
    for solid in ground.solids:
        vertices.append(solid.vertices)
        all_faces.append(solid.faces + count)
        count += len(solid.vertices)
    return np.concatenate(vertices), np.concatenate(all_faces)


def points_on(vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points (N, 3) [m] spread evenly over a mesh, `_POINTS_PER_M2` of its area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    count = int(_POINTS_PER_M2 * area.sum())
    at = rng.choice(len(faces), count, p=area / area.sum())
    s, t = rng.random((2, count, 1))
    # The square folds over its diagonal onto the triangle.
    s, t = np.where(s + t > 1.0, 1.0 - s, s), np.where(s + t > 1.0, 1.0 - t, t)
    return a[at] + s * (b - a)[at] + t * (c - a)[at]


def seen_by(renderer: DirectRenderer, camera: PinholeCamera, lens: Lens, points: np.ndarray) -> np.ndarray:
    """Whether a camera sees points (N, 3) [m], local: (N,) bool.

    `refract` only proposes the pixel; the ray that the renderer sends through it has to end at the point.
    """
    near = np.flatnonzero(_in_reach(camera, lens, points))
    pixels = np.full((len(points), 2), np.nan)
    pixels[near] = camera.project(points[near], renderer.water)
    near = near[np.isfinite(pixels[near]).all(axis=1)]
    on_image = distorted(lens, pixels[near])
    near = near[((on_image > 0.0) & (on_image < (lens.width, lens.height))).all(axis=1)]
    ends = renderer.trace(camera, pixels[near]).points
    seen = np.zeros(len(points), dtype=bool)
    # A ray that meets nothing ends at NaN, which is near nothing.
    seen[near] = np.linalg.norm(ends - points[near], axis=1) < _SAME_POINT_M
    return seen


def _in_reach(camera: PinholeCamera, lens: Lens, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) lie in the rectangle that a camera can see of, from above: (N,) bool.

    Straight rays down to the lowest point reach further than those that water bends; a margin covers waves.
    """
    plane, _ = normalised(lens)
    (u0, v0), (u1, v1) = plane.min(axis=0), plane.max(axis=0)
    rays = np.array([(u, v, 1.0) for u in (u0, u1) for v in (v0, v1)]) @ camera.cam_from_local
    fall = -rays[:, 2] / np.linalg.norm(rays, axis=1)
    if not len(points) or fall.min() < _LEAST_FALL:
        return np.ones(len(points), dtype=bool)
    t = (camera.centre[2] - points[:, 2].min()) / -rays[:, 2]
    ends = np.concatenate([camera.centre[None, :2], camera.centre[:2] + t[:, None] * rays[:, :2]])
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = 0.1 * (high - low) + 0.5
    return ((points[:, :2] >= low - margin) & (points[:, :2] <= high + margin)).all(axis=1)


def depth_map(renderer: DirectRenderer, camera: PinholeCamera, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Depth map of the bed at the middles of pixels.

    Returns
    -------
    depth : (height, width) float32 [m]
        Vertical, of the ground below the water surface, negative above it; without water, below the origin of
        local. NaN where a ray meets nothing.
    wet : (height, width) uint8
        255 where the ray enters water.
    """
    plane, _ = normalised(lens)
    direction = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1) @ camera.cam_from_local
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = camera.centres(camera.pixel_centres().reshape(-1, 2))
    hits = renderer.trace_rays(np.broadcast_to(origin, direction.shape), direction)
    depth = depth_below(renderer.water, hits.points)
    shape = (lens.height, lens.width)
    wet = np.where(hits.in_water > 0.0, 255, 0).astype(np.uint8)
    return depth.astype(np.float32).reshape(shape), wet.reshape(shape)


def write_ply(path: Path, points: np.ndarray, faces: np.ndarray | None = None) -> None:
    """Points (N, 3) and, where given, triangles (F, 3) as binary PLY with coordinates in double precision."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with path.open("wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        file.write(np.ascontiguousarray(points, dtype="<f8").tobytes())
        if faces is not None:
            rows = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
            rows["count"], rows["index"] = 3, faces
            file.write(rows.tobytes())
