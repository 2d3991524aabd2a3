"""Are the distances of `compare` those of CloudCompare, and how long do both take?

    python benchmarks/bench_compare.py [--points 1000000] [--triangles 200000] [--keep FOLDER]

Draws a rough bed as an open mesh and a cloud about it and runs on the same files, each in a process of its own:
`evaluation.distance_to_mesh` with the sign of the winding; the whole command `bathynerf compare`; CloudCompare (Debian:
`apt-get install cloudcompare`; a separate program, used as an oracle only). One line for each: seconds from files to
distances, by the clock and on all cores together, and the most memory that the process held; then how far the two
differ per point. Coordinates are drawn in float32 near zero, in which CloudCompare computes. The full size is
--points 10000000 --triangles 2000000.
"""

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

CELL_M = 0.05


def draw(folder: Path, num_points: int, num_triangles: int, seed: int = 7) -> tuple[Path, Path]:
    """A bed with relief at every scale down to its cells, and points about it, as binary PLY in float32."""
    rng = np.random.default_rng(seed)
    side = int((num_triangles / 2) ** 0.5) + 1
    size = CELL_M * (side - 1)
    x, y = np.meshgrid(np.linspace(-size / 2, size / 2, side), np.linspace(-size / 2, size / 2, side))
    z = sum(0.02 * w * np.sin(x / w + p) * np.cos(y / w - p) for w, p in ((0.2, 0.3), (1.0, 1.1), (5.0, 2.2)))
    z = z + rng.normal(0.0, 0.2 * CELL_M, x.shape)
    vertices = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + side], 1), np.stack([a + 1, a + side + 1, a + side], 1)])
    rows = rng.integers(len(faces), size=num_points)
    weights = rng.dirichlet((1.0, 1.0, 1.0), size=num_points)
    points = np.einsum("nk,nkd->nd", weights, vertices[faces[rows]].astype(np.float64))
    points += rng.normal(0.0, 0.3 * CELL_M, points.shape)
    return _ply(folder / "cloud.ply", points), _ply(folder / "mesh.ply", vertices, faces)


def _ply(path: Path, points: np.ndarray, faces: np.ndarray | None = None) -> Path:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with path.open("wb") as stream:
        stream.write(("\n".join([*lines, "end_header"]) + "\n").encode())
        stream.write(points.astype("<f4").tobytes())
        if faces is not None:
            record = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
            record["n"], record["v"] = 3, faces
            stream.write(record.tobytes())
    return path


def distances(cloud: Path, mesh: Path) -> np.ndarray:
    """Signed distances (N,) [m] of the points of a file to the mesh of another, as we compute them."""
    from evaluation import distance_to_mesh
    from geo import read_reference

    reference = read_reference(mesh)
    points = read_reference(cloud).points
    return distance_to_mesh(points, reference.vertices, reference.faces, sign="winding").signed


def timed(command: list[str], **environment: str) -> str:
    """Run a command; what it cost: seconds by the clock and on all cores together, and the most memory [GB]."""
    start = time.perf_counter()
    process = subprocess.Popen(command, env=os.environ | environment, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{command[0]} ended with code {process.returncode}")
    seconds = time.perf_counter() - start
    cpu = usage.ru_utime + usage.ru_stime
    return f"{seconds:8.1f} s  {cpu:8.1f} s on all cores  {usage.ru_maxrss / 1e6:6.2f} GB"


def run_ours(folder: Path, cloud: Path, mesh: Path) -> tuple[np.ndarray, str]:
    out = folder / "ours.npy"
    cost = timed([sys.executable, __file__, "--ours", str(cloud), str(mesh), str(out)])
    return np.load(out), cost


def run_everything(cloud: Path, mesh: Path) -> str:
    """What the whole command costs: completeness, vertical differences and intervals too."""
    command = [
        sys.executable,
        "-c",
        "from survey.commands.app import main; main()",
        "compare",
        "-q",
        str(cloud),
        str(mesh),
    ]
    return timed(command)


def cloudcompare() -> str | None:
    """The program, None where it is not installed."""
    return shutil.which("CloudCompare") or shutil.which("cloudcompare.CloudCompare")


def run_cloudcompare(program: str, folder: Path, cloud: Path, mesh: Path) -> tuple[np.ndarray, str]:
    """Signed distances in the order of the cloud, as CloudCompare's binary PLY holds them (float32)."""
    command = [program, "-SILENT", "-AUTO_SAVE", "OFF", "-NO_TIMESTAMP", "-C_EXPORT_FMT", "PLY", "-PLY_EXPORT_FMT",
               "BINARY_LE", "-O", str(cloud), "-O", str(mesh), "-C2M_DIST", "-SAVE_CLOUDS", "FILE",
               str(folder / "cc.ply")]  # fmt: skip
    cost = timed(command, QT_QPA_PLATFORM="offscreen")
    from geo import read_reference

    extra = read_reference(folder / "cc.ply").extra
    name = next(name for name in extra if "C2M" in name)
    return extra[name], cost


def closest_on_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The point (N, 3) of each triangle (N, 3, 3) [m] that is nearest to the point (N, 3) of the same row.

    The Voronoi regions of the triangle in its plane, after C. Ericson, Real-Time Collision Detection (2005), section
    5.1.5.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac = b - a, c - a
    d1, d2 = _dot(ab, points - a), _dot(ac, points - a)
    d3, d4 = _dot(ab, points - b), _dot(ac, points - b)
    d5, d6 = _dot(ab, points - c), _dot(ac, points - c)
    # Barycentric coordinates of the foot on the plane, times a common positive factor.
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    feature = np.select(
        [
            (d1 <= 0.0) & (d2 <= 0.0),
            (d3 >= 0.0) & (d4 <= d3),
            (d6 >= 0.0) & (d5 <= d6),
            (vc <= 0.0) & (d1 >= 0.0) & (d3 <= 0.0),
            (va <= 0.0) & (d4 - d3 >= 0.0) & (d5 - d6 >= 0.0),
            (vb <= 0.0) & (d2 >= 0.0) & (d6 <= 0.0),
        ],
        [4, 5, 6, 1, 2, 3],
        default=0,
    )
    ones, zeros = np.ones_like(d1), np.zeros_like(d1)
    along_ab = _share(d1, d1 - d3)
    along_bc = _share(d4 - d3, (d4 - d3) + (d5 - d6))
    along_ac = _share(d2, d2 - d6)
    total = va + vb + vc
    v = np.choose(feature, [_share(vb, total), along_ab, 1.0 - along_bc, zeros, zeros, ones, zeros])
    w = np.choose(feature, [_share(vc, total), zeros, along_bc, along_ac, zeros, zeros, ones])
    return a + v[:, None] * ab + w[:, None] * ac


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)


def _share(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """part / whole, or 0 where the whole is 0; such values belong to a region that is not chosen."""
    return np.divide(part, whole, out=np.zeros_like(part), where=whole != 0.0)


def distances_around(points: np.ndarray, sizes: np.ndarray, mesh: Path) -> Iterator[np.ndarray]:
    """Of each point, its distances [m] to all triangles that may be as near as its size and a micrometre."""
    from geo import read_reference

    reference = read_reference(mesh)
    corners = reference.vertices[reference.faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    for point, size in zip(points, sizes, strict=True):
        near = corners[((low <= point + size + 1e-6) & (high >= point - size - 1e-6)).all(axis=1)]
        nearest = closest_on_triangles(np.broadcast_to(point, (len(near), 3)), near)
        yield np.linalg.norm(nearest - point, axis=1)


def num_tied(points: np.ndarray, sizes: np.ndarray, mesh: Path) -> int:
    """Number of points with two or more triangles at their distance (to 1e-6 m), by testing all that are near."""
    around = zip(distances_around(points, sizes, mesh), sizes, strict=True)
    return sum(np.count_nonzero(found < size + 1e-6) > 1 for found, size in around)


def largest_error(points: np.ndarray, signed: np.ndarray, mesh: Path, count: int) -> float:
    """Largest error [m] of the sizes of so many distances, evenly among the points, against all triangles near."""
    some = np.linspace(0, len(points) - 1, count).astype(int)
    sizes = np.abs(signed[some]).astype(np.float64)
    around = zip(distances_around(points[some], sizes + 0.01, mesh), sizes, strict=True)
    return max(abs(found.min() - size) for found, size in around)


def say(text: str) -> None:
    sys.stdout.write(text + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--triangles", type=int, default=200_000)
    parser.add_argument("--keep", type=Path, help="leave the files in this folder")
    parser.add_argument("--ours", nargs=3, type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.ours:
        cloud, mesh, out = options.ours
        np.save(out, distances(cloud, mesh))
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(exist_ok=True)
        cloud, mesh = draw(folder, options.points, options.triangles)
        load = os.getloadavg()[0]
        say(f"{options.points} points, {options.triangles} triangles; {os.cpu_count()} cores, load {load:.1f}")
        found, cost = run_ours(folder, cloud, mesh)
        say(f"compare       {cost}")
        say(f"all measures  {run_everything(cloud, mesh)}")
        program = cloudcompare()
        if program is None:
            say("CloudCompare is not installed: nothing to compare with")
            return
        theirs, cost = run_cloudcompare(program, folder, cloud, mesh)
        say(f"CloudCompare  {cost}")
        size = np.abs(np.abs(found) - np.abs(theirs))
        say(f"unsigned distances differ by {size.max():.1e} m at most, {size.mean():.1e} m on average")
        other = np.flatnonzero(np.sign(found) * np.sign(theirs) < 0)
        from geo import read_reference

        tied = num_tied(read_reference(cloud).points[other], np.abs(found[other]), mesh)
        say(f"signs differ at {len(other)} points, {tied} of them as near to one triangle as to another")


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    main()
