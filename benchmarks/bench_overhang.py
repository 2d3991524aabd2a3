"""What of the bed lies in the cloud where something hangs over it?

    python benchmarks/bench_overhang.py SURVEY [RUN] [--draw pier|boulders SEED]

SURVEY is a folder with known truth (reference.ply and visible.ply in it, or in truth/); RUN a run folder of it, by
default SURVEY/bathynerf. Prints rows of Markdown: of the points of the surface that three cameras see, those that have
another surface above them and all others, the share within 0.05 m of the cloud; of the points of the cloud, under a
surface and in all, the share farther than 0.05 m from the truth. What boxes found (user data 1, docs/field.md) stands
apart: both shares without these points, their number, how many of them lie within 0.05 and 0.1 m of the truth and
within 1.96 of their std. ``--draw`` draws the survey first; it is then for `bathynerf process`.
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import laspy
import numpy as np

from evaluation.c2m import distance_to_mesh
from evaluation.completeness import is_reached
from geo import LocalFrame, read_reference
from geo.las_header import extra_of
from survey.folder.survey import load_survey
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.ground.ground import Ground, Material, shade_beside_bed, shade_of_map
from survey.simulate.ground.shapes import BedGrid, Solid, TriangleMesh, rotation
from survey.simulate.ground.textures import ROCK, ImageTexture, light_of_bed, periodic
from survey.simulate.light import Light
from survey.simulate.output.sidecars import StagedScene
from survey.simulate.output.writing import write_survey

KINDS = ("pier", "boulders")
_WOOD = (0.42, 0.29, 0.18)
# Spacings of the speckle of bodies, in its 512 texels of half a ground sampling distance.
_SPECKLE = (2, 4, 8, 32)
# Tries at a place for a boulder that touches no other.
_TRIES = 200
Bodies = list[tuple[Solid, tuple[float, float, float]]]
NEAR_M = 0.05
# Points have a surface above them where one is higher by more than this: beyond rounding and the edges of facets.
ABOVE_M = 0.02
HEADER = (
    "| survey | visible points under a surface [%] | of them found [%] | of the others [%] | of all [%] | points | "
    "of them under a surface | of these beyond 5 cm [%] | of all [%] | median std [mm] | without boxes: found under a "
    "surface [%] | of the others [%] | points of boxes | within 5 cm [%] | 10 cm [%] | 1.96 std [%] |"
)


@dataclass(frozen=True)
class OverhangSurvey:
    """A survey of one of `KINDS`, its sizes and its flight by a seed."""

    kind: str
    seed: int

    @property
    def scene(self) -> DrawnScene:
        rng = np.random.default_rng([self.seed, KINDS.index(self.kind), 51])
        width = float(rng.uniform(9.0, 11.0))
        return DrawnScene(
            size_m=(width, 0.9 * width),
            depth_m=float(rng.uniform(2.2, 3.4)),
            n_water=float(rng.uniform(1.33, 1.345)),
            num_views=int(rng.integers(22, 29)),
            nadir_share=float(rng.uniform(0.4, 0.6)),
            image_px=(640, 480),
            focal_px=1120.0,
            flying_m=float(rng.uniform(18.0, 24.0)),
            noise=float(rng.uniform(0.8, 2.0)),
            seed=self.seed,
            objects=False,
        )

    def draw(self, folder: Path) -> None:
        """Write the survey, with its truth, into a folder; what was there goes."""
        shutil.rmtree(folder, ignore_errors=True)
        write_survey(folder, asdict(self.scene) | {"kind": self.kind}, self._staged)

    def _staged(self) -> StagedScene:
        scene = self.scene
        staged = stage_drawing(scene)
        bed, material = staged.renderer.ground.bed, staged.renderer.ground.materials[0]
        assert isinstance(bed, BedGrid)
        rng = np.random.default_rng([self.seed, 52])
        bodies = (pier if self.kind == "pier" else boulders)(rng, bed, scene.size_m)
        solids, light = tuple(solid for solid, _ in bodies), Light()
        materials = [Material(material.texture, shade_of_map(bed, light_of_bed(bed, solids, light)))]
        texel = 0.5 * scene.flying_m / scene.focal_px
        materials += [
            Material(_speckled(rng, s, colour, texel), shade_beside_bed(s, bed, light)) for s, colour in bodies
        ]
        return replace(staged, renderer=replace(staged.renderer, ground=Ground(bed, solids, tuple(materials))))


def pier(rng: np.random.Generator, bed: BedGrid, size_m: tuple[float, float]) -> Bodies:
    """A sunken deck of planks 0.7 to 1.3 m above the bed, on two rows of posts, and free posts beside it."""
    length, wide, thick = rng.uniform(0.45, 0.6) * size_m[0], rng.uniform(1.0, 1.6), rng.uniform(0.08, 0.2)
    turn = rotation(rng.uniform(0.0, math.pi))
    deck = float(bed.height(0.0, 0.0)) + rng.uniform(0.7, 1.3)

    def placed(points: np.ndarray) -> Solid:
        return Solid.around(points @ turn.T)

    bodies: Bodies = []
    # Some planks are missing.
    pieces = 7
    for piece in range(pieces):
        if rng.random() < 0.15:
            continue
        x0 = length * (piece / pieces - 0.5)
        corners = _box((x0, -0.5 * wide, deck - thick), (x0 + 0.97 * length / pieces, 0.5 * wide, deck))
        bodies.append((placed(corners), _shaded(rng, _WOOD)))
    radius, posts = rng.uniform(0.05, 0.1), int(rng.integers(4, 6))
    for x in length * (np.linspace(0.04, 0.96, posts) - 0.5):
        for y in (-0.45 * wide, 0.45 * wide):
            foot = turn @ (x, y, 0.0)
            low = float(bed.height(foot[0], foot[1])) - 0.2
            bodies.append((placed(_post(x, y, radius, low, deck + rng.uniform(-0.01, 0.4))), _shaded(rng, _WOOD)))
    for _ in range(5):
        x, y = rng.uniform(-0.45, 0.45) * size_m[0], rng.uniform(0.22, 0.4) * size_m[1] * rng.choice([-1.0, 1.0])
        low = float(bed.height(x, y))
        solid = Solid.around(_post(x, y, rng.uniform(0.05, 0.12), low - 0.2, low + rng.uniform(0.5, 1.4)))
        bodies.append((solid, _shaded(rng, _WOOD)))
    return bodies


def boulders(rng: np.random.Generator, bed: BedGrid, size_m: tuple[float, float]) -> Bodies:
    """Boulders of 0.5 to 1.5 m, 1.3 to 2.5 times as wide above as at their foot."""
    bodies: Bodies = []
    places: list[tuple[float, float, float]] = []
    for _ in range(int(rng.integers(18, 26))):
        radius = float(rng.uniform(0.25, 0.75))
        for _ in range(_TRIES):
            x, y = (rng.uniform(-0.46, 0.46) * size for size in size_m)
            if all(math.hypot(x - u, y - v) > radius + r for u, v, r in places):
                break
        else:
            continue
        places.append((x, y, radius))
        height, foot = radius * rng.uniform(0.8, 1.8), radius / rng.uniform(1.3, 2.5)
        angles = np.sort(rng.uniform(0.0, 2.0 * math.pi, 14))
        rings = [
            np.stack([r * np.cos(angles), r * np.sin(angles), np.full(14, z)], axis=-1)
            * rng.uniform(0.85, 1.15, (14, 1))
            for r, z in ((foot, -0.1), (radius, 0.65 * height), (0.7 * radius, height))
        ]
        rings[0][:, 2] = -0.1
        solid = Solid.around(np.concatenate(rings) + np.array([x, y, float(bed.height(x, y))]))
        bodies.append((solid, _shaded(rng, ROCK)))
    return bodies


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
    return np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)


def _post(x: float, y: float, radius: float, low: float, high: float, sides: int = 12) -> np.ndarray:
    angle = 2.0 * math.pi * np.arange(sides) / sides
    circle = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=-1)
    return np.concatenate([np.column_stack([circle, np.full(sides, z)]) for z in (low, high)])


def _shaded(rng: np.random.Generator, colour: tuple[float, float, float]) -> tuple[float, float, float]:
    red, green, blue = rng.uniform(0.8, 1.25) * np.array(colour)
    return float(red), float(green), float(blue)


def _speckled(
    rng: np.random.Generator, solid: Solid, colour: tuple[float, float, float], texel_m: float
) -> ImageTexture:
    """A periodic speckle, laid along each plane of a body."""
    tile = np.exp(sum(0.15 * periodic(rng, spacing) for spacing in _SPECKLE)).astype(np.float32)
    across = np.cross(solid.normals, (0.8, 0.1, 0.6)) + 1e-12
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([across, np.cross(across, solid.normals)], axis=1) / texel_m
    shift = np.arange(len(axes))[:, None] * (7.0, 31.0) - axes @ solid.centre
    image = tile[..., None] * np.array(colour, dtype=np.float32)
    return ImageTexture(image, np.concatenate([axes, shift[..., None]], axis=-1), np.arange(len(axes)), repeats=True)


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("survey", type=Path)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--draw", nargs=2, metavar=("KIND", "SEED"), help=f"one of {', '.join(KINDS)}, and a number")
    options = parser.parse_args()
    if options.draw is not None:
        kind, seed = options.draw
        OverhangSurvey(kind, int(seed)).draw(options.survey)
        return
    sys.stdout.write(f"{HEADER}\n{row(Truth.of(options.survey), options.run or options.survey / 'bathynerf')}\n")


if __name__ == "__main__":
    main()
