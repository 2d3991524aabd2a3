"""How well do meshes of a run fit the true surface, against the cloud that they are made of?

    python benchmarks/bench_mesh.py RUN SURVEY

RUN is a run of SURVEY, a survey with known truth (reference.ply, visible.ply in it or in truth/). One line for the
cloud and one for each method, within the bounds of the survey: C2M of the points or vertices, completeness of the
visible points at 5 cm and 2 cm, of a mesh by as many samples of its surface as the cloud has points, and seconds on one
core. Poisson needs the extra ``mesh``. docs/meshes.md has the figures.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from evaluation.c2m import distance_to_mesh, is_reached, sample_mesh
from geo.reading import read_reference
from survey.export.meshes import bed_surface
from survey.plan.area import within
from survey.run.flight import load_flight
from survey.run.folder import RunDir
from survey.run.stored import load_bed

TOLERANCES_M = (0.05, 0.02)
METHODS = ("delaunay", "poisson")


class Truth:
    """The true surface and the points of it that cameras see, local."""

    def __init__(self, run: Path, survey: Path):
        flight = load_flight(run)
        frame = flight.frame
        truth = survey / "truth" if (survey / "truth").is_dir() else survey
        reference = read_reference(truth / "reference.ply")
        self.vertices, self.faces = frame.local_from_crs(reference.vertices), reference.faces
        self.visible = frame.local_from_crs(read_reference(truth / "visible.ply").points)
        e0, n0, e1, n1 = flight.bounds
        level = frame.origin[2]
        corners = frame.local_from_crs([[e0, n0, level], [e1, n1, level]])
        self.area = (*corners[0, :2], *corners[1, :2])

    def line(self, name: str, points: np.ndarray, samples: np.ndarray, num_faces: int, seconds: float) -> str:
        """One row of the table: C2M of points (N, 3), completeness by samples (M, 3)."""
        size = np.abs(distance_to_mesh(points[within(points, self.area)], self.vertices, self.faces).signed)
        c2m = (size.mean(), np.sqrt((size**2).mean()), np.median(size), np.quantile(size, 0.95))
        reached = [100.0 * is_reached(self.visible, samples, tolerance_m=limit).mean() for limit in TOLERANCES_M]
        numbers = [f"{1000.0 * value:.1f}" for value in c2m] + [f"{share:.2f}" for share in reached]
        return f"| {name} | {num_faces:,} | " + " | ".join(numbers) + f" | {seconds:.0f} |\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("survey", type=Path)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    options = parser.parse_args()
    truth = Truth(options.run, options.survey)
    stored = load_bed(RunDir(options.run).load_stage("bed"))
    bed = stored.bed
    sys.stdout.write(
        "| | triangles | mean | RMS | median | 95 % [mm] | complete at 5 cm | at 2 cm [%] | s |\n|---|"
        + "---|" * 8
        + "\n"
    )
    sys.stdout.write(truth.line("cloud", bed.xyz, bed.xyz, 0, 0.0))
    for method in options.methods:
        start = time.perf_counter()
        mesh = bed_surface(bed, spacing_m=stored.gsd_m, method=method, path=method)
        seconds = time.perf_counter() - start
        samples, _ = sample_mesh(mesh.vertices, mesh.faces, len(bed))
        sys.stdout.write(truth.line(method, mesh.vertices, samples, len(mesh.faces), seconds))


if __name__ == "__main__":
    main()
