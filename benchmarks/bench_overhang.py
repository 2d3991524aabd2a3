"""What of the bed lies in the cloud where something hangs over it?

    python benchmarks/bench_overhang.py SURVEY [RUN] [--draw pier|boulders SEED] [--windows N]

SURVEY is a folder with known truth (reference.ply and visible.ply in it, or in truth/); RUN a run folder of it, by
default SURVEY/bathynerf. Prints rows of Markdown: of the points of the surface that three cameras see, those that have
another surface above them and all others, the share within 0.05 m of the cloud; of the points of the cloud, under a
surface and in all, the share farther than 0.05 m from the truth. What boxes found (user data 1, docs/field.md) stands
apart: both shares without these points, their number, how many of them lie within 0.05 and 0.1 m of the truth and
within 1.96 of their std. ``--draw`` draws the survey first
(`benchmarks/overhang_scenes.py`); it is then for `bathynerf process`. ``--windows`` sweeps the survey and says at which
share of N points of each kind the right height wins (`benchmarks/overhang_windows.py`).
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
from bench_sweep import Case
from overhang_scenes import KINDS, OverhangSurvey
from overhang_windows import Windows, table

from evaluation.c2m import distance_to_mesh
from evaluation.completeness import is_reached
from geo import LocalFrame, read_reference
from geo.las_header import extra_of
from survey.folder.survey import load_survey
from survey.simulate.ground.shapes import TriangleMesh

NEAR_M = 0.05
# Points have a surface above them where one is higher by more than this: beyond rounding and the edges of facets.
ABOVE_M = 0.02


@dataclass(frozen=True)
class Truth:
    """The true surface of a survey, local [m], and its points that three cameras see; `hidden` of them lie under it."""

    frame: LocalFrame
    bounds: tuple[float, float, float, float] | None
    surface: TriangleMesh
    visible: np.ndarray
    under: np.ndarray

    @classmethod
    def of(cls, folder: Path) -> Truth:
        """That in the folder of a survey."""
        survey, truth = load_survey(folder), folder / "truth" if (folder / "truth").is_dir() else folder
        mesh = read_reference(truth / "reference.ply")
        surface = TriangleMesh(survey.frame.local_from_crs(mesh.vertices), mesh.faces)
        visible = survey.frame.local_from_crs(read_reference(truth / "visible.ply").points)
        return cls(survey.frame, survey.bounds, surface, visible, is_under(surface, visible))

    def completeness(self, cloud: np.ndarray) -> tuple[float, float]:
        """Share [-] of the visible points near a cloud (N, 3): of those under a surface, and of the others."""
        reached = is_reached(self.visible, cloud, tolerance_m=NEAR_M)
        return float(reached[self.under].mean()), float(reached[~self.under].mean())


def is_under(surface: TriangleMesh, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) have the surface above them: (N,) bool."""
    return surface.height(points[:, 0], points[:, 1]) > points[:, 2] + ABOVE_M


def row(truth: Truth, run: Path) -> str:
    """The figures of a run."""
    las = laspy.read(run / "cloud.las")
    points = np.stack([las.x, las.y, las.z], axis=-1)
    inside = np.ones(len(points), dtype=bool)
    if truth.bounds is not None:
        e0, n0, e1, n1 = truth.bounds
        inside = (points[:, 0] >= e0) & (points[:, 0] <= e1) & (points[:, 1] >= n0) & (points[:, 1] <= n1)
    local, std = truth.frame.local_from_crs(points), np.asarray(extra_of(las)["std"])[inside]
    under, others = truth.completeness(local)
    local = local[inside]
    error = np.abs(distance_to_mesh(local, truth.surface.vertices, truth.surface.faces).signed)
    below = is_under(truth.surface, local + np.array([0.0, 0.0, NEAR_M]))
    of_boxes = np.asarray(las.user_data) == 1
    before = truth.completeness(truth.frame.local_from_crs(points[~of_boxes]))
    new, spread = error[of_boxes[inside]], std[of_boxes[inside]]
    shares = [np.mean(new <= limit) if len(new) else np.nan for limit in (NEAR_M, 2.0 * NEAR_M, 1.96 * spread)]
    cells = [
        f"{100 * truth.under.mean():.2f}", f"{100 * under:.2f}", f"{100 * others:.2f}",
        f"{100 * np.mean(np.where(truth.under, under, others)):.2f}",
        f"{len(local)}", f"{int(below.sum())}", f"{100 * np.mean(error[below] > NEAR_M):.2f}",
        f"{100 * np.mean(error > NEAR_M):.3f}", f"{1e3 * np.median(std):.2f}",
        *(f"{100 * share:.2f}" for share in before), f"{len(new)}", *(f"{100 * share:.1f}" for share in shares),
    ]  # fmt: skip
    return "| " + " | ".join([run.parent.name, *cells]) + " |"


HEADER = (
    "| survey | visible points under a surface [%] | of them found [%] | of the others [%] | of all [%] | points | "
    "of them under a surface | of these beyond 5 cm [%] | of all [%] | median std [mm] | without boxes: found under a "
    "surface [%] | of the others [%] | points of boxes | within 5 cm [%] | 10 cm [%] | 1.96 std [%] |"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("survey", type=Path)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--draw", nargs=2, metavar=("KIND", "SEED"), help=f"one of {', '.join(KINDS)}, and a number")
    parser.add_argument("--windows", type=int, metavar="N", help="points of each kind")
    options = parser.parse_args()
    if options.windows is not None:
        case, truth = Case(options.survey, "standard"), Truth.of(options.survey)
        windows = Windows(case, case.maps()[0], truth.surface)
        sys.stdout.write(table(windows, truth.visible, truth.under, options.windows) + "\n")
        return
    if options.draw is not None:
        kind, seed = options.draw
        OverhangSurvey(kind, int(seed)).draw(options.survey)
        return
    sys.stdout.write(f"{HEADER}\n{row(Truth.of(options.survey), options.run or options.survey / 'bathynerf')}\n")


if __name__ == "__main__":
    main()
