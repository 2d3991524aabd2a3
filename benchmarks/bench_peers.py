"""What does the same work cost beside programs that pip has, in one run on one machine?

    python benchmarks/bench_peers.py [--only WORK ...] [--photographs 40 100 500] [--runs 3] [--publish]

Each program does the work in a process of its own, in turn with the others, `--runs` times, once where ours takes more
than 8 s; medians are kept. Time and processor time [s] are those of the work, without imports; memory is the most that
the process held; accuracy is in mm. The same input is drawn for all:

adjustment  a dry block (`bench_block_size.py`), positions of GPS to 0.3 m; median error of the positions. pycolmap (one
            thread) solves once, ours has its rounds, checks and covariance.
c2m         a rough bed of twice as many triangles as points (`bench_compare.py`), files to signed distances; the
            largest error, of 200 points, against all triangles. Open3D (`pip install open3d`) computes in float32;
            CloudCompare where it is installed, its start included.
laz         nine times as many points (1.6 million) with five extra values; size of the file. laspy with lazrs, which
            ours uses, too.
dense       the survey of the demo, draft, its photographs to a cloud; std of the inner 90 % and completeness at 0.05 m.
            AquaMVS (`pip install aquamvs`): its plane sweep of one of the 20 photographs with four neighbours, told
            the depths that are there; std of these depths.

A program that is not installed is left out, and said. --publish writes benchmarks/results/peers.json, in which works
that were not asked for stay, and from which `make tables` writes the table of docs/performance.md.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import bench_compare
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

PUBLISHED = Path(__file__).resolve().parent / "results" / "peers.json"
# Photographs that AquaMVS sweeps, neighbours of each.
SWEPT, NEIGHBOURS = 1, 4
CHECKED = 200
# Processor time [s] of ours from which a work is done once.
ONCE_S = 8.0
# What `make demo` draws.
DEMO = Path(__file__).resolve().parent.parent / ".demo" / "survey"
# What is timed, and what says how accurate its result is.
Timed = tuple[Callable[[], Any], Callable[[Any], str]]


def adjustment(work: Path, peer: str | None) -> Timed:
    """A block of as many photographs as the folder is named after."""
    import bench_block_size as blocks

    block, survey = blocks.drawn(int(work.name), dry=True)

    def accuracy(centres: np.ndarray) -> str:
        true = np.array([camera.centre for camera in block.cameras])
        return f"{1e3 * np.median(np.linalg.norm(centres - true, axis=1)):.0f}"

    if peer is None:
        blocks.warm_up()
        return lambda: blocks.adjust_survey(survey, use_windows=False).poses.centres, accuracy
    return lambda: blocks.solved_by_pycolmap(survey)[0], accuracy


def c2m(work: Path, peer: str | None) -> Timed:
    """Signed distances of the points of a file to the mesh of another."""
    cloud, mesh = work / "cloud.ply", work / "mesh.ply"

    def accuracy(signed: np.ndarray) -> str:
        from geo import read_reference

        return f"{1e3 * bench_compare.largest_error(read_reference(cloud).points, signed, mesh, CHECKED):.4f}"

    if peer is None:
        import evaluation  # noqa: F401
        import geo  # noqa: F401

        return lambda: bench_compare.distances(cloud, mesh), accuracy
    if peer == "CloudCompare":
        program = bench_compare.cloudcompare()
        return lambda: bench_compare.run_cloudcompare(program, work, cloud, mesh)[0], accuracy
    import open3d

    def by_open3d() -> np.ndarray:
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(open3d.t.io.read_triangle_mesh(str(mesh)))
        points = open3d.t.io.read_point_cloud(str(cloud)).point.positions
        found = scene.compute_closest_points(points)
        off = points.numpy() - found["points"].numpy()
        above = np.einsum("ij,ij->i", off, found["primitive_normals"].numpy()) >= 0.0
        return np.where(above, 1.0, -1.0) * np.linalg.norm(off, axis=1)

    return by_open3d, accuracy


def laz(work: Path, peer: str | None) -> Timed:
    """A cloud in memory to a file."""
    import laspy

    from geo import parse_crs, write_cloud
    from geo.las_header import EXTRA_BYTES

    stored = np.load(work / "points.npz")
    points, rgb, is_wet = stored["points"], stored["rgb"], stored["is_wet"]
    extra = {name: stored[name] for name in ("depth", "std", "num_views", "incidence", "std_common")}
    file = work / f"{peer or 'ours'}.laz"

    def ours() -> None:
        named = {name if name == "num_views" else name + ("_deg" if name == "incidence" else "_m"): values
                 for name, values in extra.items()}  # fmt: skip
        write_cloud(file, points, parse_crs("EPSG:25832+7837"), rgb=rgb, is_wet=is_wet, **named)

    def by_laspy() -> None:
        header = laspy.LasHeader(version="1.4", point_format=7)
        header.scales, header.offsets = np.full(3, 0.001), np.floor(points.mean(axis=0))
        header.add_extra_dims([laspy.ExtraBytesParams(*each[:2]) for each in EXTRA_BYTES if each[0] in extra])
        las = laspy.LasData(header)
        las.x, las.y, las.z = points.T
        las.red, las.green, las.blue = rgb.astype(np.uint16).T * np.uint16(257)
        las.classification = np.where(is_wet, 40, 2)
        las.return_number, las.number_of_returns, las.synthetic = (np.ones(len(points), np.uint8) for _ in range(3))
        for name, values in extra.items():
            las[name] = values
        las.write(file)

    return by_laspy if peer else ours, lambda _: f"{file.stat().st_size / 1e6:.1f} MB"


def dense(work: Path, peer: str | None) -> Timed:
    """Photographs of a drawn survey to heights of its bed."""
    from evaluation import is_reached, vertical_difference
    from geo import read_cloud, read_reference
    from survey.folder.survey import load_survey
    from survey.progress import Progress
    from survey.run.process import process

    survey = load_survey(work)
    mesh, e0, n0, e1, n1 = read_reference(work / "truth" / "reference.ply"), *survey.bounds

    def errors(crs: np.ndarray) -> np.ndarray:
        inside = (crs[:, 0] >= e0) & (crs[:, 0] <= e1) & (crs[:, 1] >= n0) & (crs[:, 1] <= n1)
        to_local = survey.frame.local_from_crs
        found = vertical_difference(to_local(crs[inside]), to_local(mesh.vertices), mesh.faces)
        found = found[np.isfinite(found)]
        return found[np.abs(found) <= np.quantile(np.abs(found), 0.9)]

    def ours() -> np.ndarray:
        with Progress(verbosity=-1):
            process(work, Path(tempfile.mkdtemp(dir=work)), quality="draft", field="off")
        return read_cloud(max(work.glob("*/cloud.las"), key=lambda path: path.stat().st_mtime)).points

    def accuracy(crs: np.ndarray) -> str:
        visible = read_reference(work / "truth" / "visible.ply").points
        reached = is_reached(*map(survey.frame.local_from_crs, (visible, crs)), tolerance_m=0.05).mean()
        return f"{1e3 * errors(crs).std():.1f}, {100.0 * reached:.1f} %"

    if peer is None:
        return ours, accuracy
    swept = _aquamvs(survey)
    return swept, lambda points: f"{1e3 * errors(survey.frame.crs_from_local(points)).std():.1f}"


def _aquamvs(survey: Any) -> Callable[[], np.ndarray]:
    """A sweep of some photographs by AquaMVS: points (N, 3) [m], local, under level water."""
    # Its imports ask for these, which pip does not have and its sweep does not use.
    for name in ("lightglue", "romav2", "romav2.geometry"):
        sys.modules[name] = stub = MagicMock()
        stub.__spec__ = ModuleSpec(name, None)
    import cv2
    import torch
    from aquamvs.config import ReconstructionConfig
    from aquamvs.dense.plane_sweep import extract_depth, plane_sweep_stereo
    from aquamvs.projection.refractive import RefractiveProjectionModel

    down, views, water = np.diag([1.0, -1.0, -1.0]), survey.views, survey.water
    middle = np.mean([view.camera.centre for view in views], axis=0)
    level = float(water.point[2])

    def model(view: Any) -> RefractiveProjectionModel:
        rotation, lens = view.camera.cam_from_local @ down, view.lens
        matrix = np.diag([*lens.focal, 1.0])
        # The centre of the first pixel is at 0 there.
        matrix[:2, 2] = lens["cx"] - 0.5, lens["cy"] - 0.5
        shift = -view.camera.cam_from_local @ view.camera.centre
        tensors = (torch.tensor(each, dtype=torch.float32) for each in (matrix, rotation, shift))
        return RefractiveProjectionModel(*tensors, -level, torch.tensor([0.0, 0.0, -1.0]), 1.0, water.n_water)

    def sweep() -> np.ndarray:
        models = {view.name: model(view) for view in views}
        images = {view.name: torch.from_numpy(cv2.imread(str(view.path))) for view in views}
        centres = np.array([view.camera.centre for view in views])
        from_middle = np.linalg.norm(centres - middle, axis=1)
        found = []
        for at in np.argsort(from_middle)[:SWEPT]:
            near = np.argsort(np.linalg.norm(centres - centres[at], axis=1))[1 : NEIGHBOURS + 1]
            own, names = views[at].name, [views[k].name for k in near]
            swept = plane_sweep_stereo(
                own, models[own], names, models, images[own], images, (1.0, 4.5), ReconstructionConfig()
            )
            depth, _ = extract_depth(swept["cost_volume"], swept["depths"])
            rows, columns = torch.meshgrid(*(torch.arange(n) for n in depth.shape), indexing="ij")
            start, along = models[own].cast_ray(torch.stack([columns.ravel(), rows.ravel()], dim=1).float())
            points = (start + depth.reshape(-1, 1) * along).numpy() @ down
            found.append(points[np.isfinite(points).all(axis=1)])
        return np.concatenate(found)

    return sweep


WORKS: dict[str, Callable[[Path, str | None], Timed]] = {
    "adjustment": adjustment,
    "c2m": c2m,
    "laz": laz,
    "dense": dense,
}
PEERS = {"adjustment": ("pycolmap",), "c2m": ("open3d", "CloudCompare"), "laz": ("laspy",), "dense": ("aquamvs",)}


def draw(work: str, folder: Path, points: int) -> None:
    """What all programs of a work read."""
    rng = np.random.default_rng(4)
    if work == "c2m":
        bench_compare.draw(folder, points, round(1.951 * points))
    if work == "laz":
        count = 9 * points
        plan = rng.uniform(0.0, 100.0, (count, 2))
        plan = plan[np.lexsort((plan[:, 0], np.floor(4.0 * plan[:, 1])))]
        height = np.sin(0.2 * plan[:, 0]) + np.cos(0.15 * plan[:, 1]) + rng.normal(0.0, 0.01, count)
        np.savez(
            folder / "points.npz",
            points=np.column_stack([676120.0 + plan[:, 0], 5311480.0 + plan[:, 1], 580.0 + height]),
            rgb=rng.integers(60, 120, (count, 3), dtype=np.uint8),
            is_wet=height < 0.5,
            depth=(1.0 - height).astype(np.float32),
            std=(0.01 + 0.002 * rng.random(count)).astype(np.float32),
            std_common=(0.01 + 0.001 * height).astype(np.float32),
            num_views=rng.integers(2, 9, count).astype(np.uint16),
            incidence=(20.0 + rng.normal(0.0, 1.0, count)).astype(np.float32),
        )
    if work == "dense" and (DEMO / "truth").is_dir():
        shutil.copytree(DEMO, folder, dirs_exist_ok=True)
    elif work == "dense":
        from survey.simulate.drawn import DrawnScene, draw_survey

        draw_survey(folder, DrawnScene())


def program(peer: str | None) -> str | None:
    """Name and version of a program; None where it is not installed."""
    if peer == "CloudCompare":
        return peer if bench_compare.cloudcompare() else None
    try:
        return f"{peer} {version(peer)}" if peer else "bathynerf"
    except PackageNotFoundError:
        return None


def measure(work: str, folder: Path, peer: str | None) -> dict:
    """One run, in this process; of a program that runs as another, that one's processor time and memory."""
    timed, accuracy = WORKS[work](folder, peer)
    who = resource.RUSAGE_CHILDREN if peer == "CloudCompare" else resource.RUSAGE_SELF
    before, start = resource.getrusage(who), time.perf_counter()
    found = timed()
    wall, after = time.perf_counter() - start, resource.getrusage(who)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"cpu_s": spent, "wall_s": wall, "peak_mb": after.ru_maxrss / 1e3, "accuracy": accuracy(found)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=WORKS, default=list(WORKS))
    parser.add_argument("--photographs", nargs="+", type=int, default=[40, 100, 500])
    parser.add_argument("--points", type=int, default=181_717)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--publish", action="store_true")
    parser.add_argument("--measure", nargs=3, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.measure:
        work, folder, peer = asked.measure
        print(json.dumps(measure(work, Path(folder), peer or None)))  # noqa: T201
        return
    rows, missing = [], []
    with tempfile.TemporaryDirectory() as temporary:
        for work in asked.only:
            for size in asked.photographs if work == "adjustment" else [0]:
                folder = Path(temporary) / work / str(size)
                folder.mkdir(parents=True)
                draw(work, folder, asked.points)
                peers = [peer for peer in (None, *PEERS[work]) if program(peer)]
                missing += [peer for peer in PEERS[work] if peer not in peers and peer not in missing]
                runs: dict[str | None, list[dict]] = {peer: [] for peer in peers}
                for number in range(asked.runs):
                    if number and runs[None][0]["cpu_s"] > ONCE_S:
                        break
                    for peer in peers:
                        command = [sys.executable, __file__, "--measure", work, str(folder), peer or ""]
                        out = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
                        runs[peer].append(json.loads(out.splitlines()[-1]))
                for peer, found in runs.items():
                    figures = {
                        key: float(np.median([run[key] for run in found])) for key in ("cpu_s", "wall_s", "peak_mb")
                    }
                    row = {"work": work, "size": size, "program": program(peer), "accuracy": found[0]["accuracy"]}
                    rows.append(row | {key: float(f"{value:.4g}") for key, value in figures.items()})
                    print(json.dumps(rows[-1]), flush=True)  # noqa: T201
    for peer in missing:
        print(f"{peer} is not installed: left out")  # noqa: T201
    if asked.publish:
        from bench_methods import machine

        before = json.loads(PUBLISHED.read_text(encoding="utf-8")) if PUBLISHED.is_file() else {"rows": []}
        kept = [row for row in before["rows"] if row["work"] not in asked.only]
        rows = sorted(kept + rows, key=lambda row: list(WORKS).index(row["work"]))
        found = {"machine": machine(), "points": asked.points, "runs": asked.runs, "rows": rows, "missing": missing}
        PUBLISHED.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
