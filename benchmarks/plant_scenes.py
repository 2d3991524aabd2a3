"""Surveys of plants over a bed, drawn at random: patches of leaves, still or leaning otherwise in each photograph."""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.ground.ground import Ground, Material, shade_of_map, shade_of_normals
from survey.simulate.ground.shapes import BedGrid, Solid
from survey.simulate.ground.textures import ImageTexture, light_of_bed, periodic
from survey.simulate.light import Light
from survey.simulate.output.sidecars import StagedScene
from survey.simulate.output.writing import write_survey

# Of a leaf: widths at its foot and its tip, and thickness [m].
WIDE, TIP, THICK = 0.07, 0.03, 0.012
PATCHES, LEAVES, SHADES = 5, 22, 6
GREEN = (0.10, 0.22, 0.06)


@dataclass(frozen=True)
class Leaf:
    """A leaf on the bed: its foot, height, the way it faces, and the phase of its motion."""

    foot: np.ndarray  # (3,) [m], local
    height: float
    facing: float  # [rad]
    phase: float  # [rad]

    def solid(self, lean: np.ndarray) -> Solid:
        """The leaf with its tip aside of its foot by ``lean`` (2,) of its height, which it keeps in length."""
        aside = self.height * np.array([*lean, 0.0])
        tip = self.foot + aside + [0.0, 0.0, math.sqrt(max(self.height**2 - float(aside @ aside), 0.0))]
        along = np.array([math.cos(self.facing), math.sin(self.facing), 0.0])
        across = np.array([-along[1], along[0], 0.0])
        corners = [
            centre + 0.5 * (u * width * along + v * THICK * across)
            for centre, width in ((self.foot - [0.0, 0.0, 0.05], WIDE), (tip, TIP))
            for u in (-1, 1)
            for v in (-1, 1)
        ]
        return Solid.around(np.array(corners))


@dataclass(frozen=True)
class Swaying(StagedScene):
    """A staged scene whose plants lean otherwise in each photograph; the truth has them upright."""

    grounds: tuple[Ground, ...] = ()

    def photograph(self, index: int) -> np.ndarray:
        renderer, camera = self.at(index)
        moved = replace(renderer, ground=self.grounds[index])
        return self.sensor.photograph(moved.radiance_of_rays, camera, self.lens, (self.seed, index))


@dataclass(frozen=True)
class PlantSurvey:
    """A survey with plants by a seed; ``sway`` is how far a tip moves aside, of its height; 0 stands still."""

    seed: int
    sway: float = 0.0

    @property
    def scene(self) -> DrawnScene:
        """The bed and the flight."""
        rng = np.random.default_rng([self.seed, 61])
        return DrawnScene(
            size_m=(6.0, 5.5),
            depth_m=float(rng.uniform(1.5, 2.5)),
            num_views=18,
            nadir_share=0.5,
            image_px=(384, 288),
            focal_px=700.0,
            flying_m=12.0,
            noise=1.5,
            seed=self.seed,
            objects=False,
        )

    def leaves(self, bed: BedGrid) -> list[Leaf]:
        """The leaves of all patches."""
        rng, (east, north) = np.random.default_rng([self.seed, 62]), self.scene.size_m
        found = []
        for _ in range(PATCHES):
            middle = rng.uniform(-0.36, 0.36, 2) * (east, north)
            tall = rng.uniform(0.25, 0.6)
            for x, y in middle + rng.normal(0.0, 0.28, (LEAVES, 2)):
                foot = np.array([x, y, float(bed.height(x, y))])
                found.append(Leaf(foot, tall * rng.uniform(0.7, 1.2), *rng.uniform(0.0, 2.0 * math.pi, 2)))
        return found

    def draw(self, folder: Path) -> list[Leaf]:
        """Write the survey, with its truth, into a folder, unless it is there as this file draws it."""
        code = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
        write_survey(folder, asdict(self.scene) | {"sway": self.sway, "plants": code}, self.staged)
        bed = stage_drawing(self.scene).renderer.ground.bed
        assert isinstance(bed, BedGrid)
        return self.leaves(bed)

    def staged(self) -> StagedScene:
        """The scene, ready to be photographed."""
        staged = stage_drawing(self.scene)
        bed, material = staged.renderer.ground.bed, staged.renderer.ground.materials[0]
        assert isinstance(bed, BedGrid)
        leaves, rng = self.leaves(bed), np.random.default_rng([self.seed, 63])
        tile = np.exp(sum(0.2 * periodic(rng, spacing) for spacing in (2, 4, 8)))[..., None]
        paints = [(tile * np.array(GREEN) * shade).astype(np.float32) for shade in np.linspace(0.6, 1.5, SHADES)]
        # The shadow on the bed is that of upright leaves in all photographs.
        solids = tuple(leaf.solid(np.zeros(2)) for leaf in leaves)
        material = replace(material, shade=shade_of_map(bed, light_of_bed(bed, solids, Light())))
        upright = _ground(bed, material, leaves, paints, np.zeros((len(leaves), 2)))
        renderer = replace(staged.renderer, ground=upright)
        if not self.sway:
            return replace(staged, renderer=renderer)
        grounds = []
        for number, _ in enumerate(staged.cameras):
            phase = np.array([leaf.phase for leaf in leaves]) + 2.0 * math.pi * 0.37 * number
            lean = self.sway * np.stack([np.sin(phase), 0.4 * np.cos(phase)], axis=-1)
            grounds.append(_ground(bed, material, leaves, paints, lean))
        return Swaying(**{**vars(staged), "renderer": renderer}, grounds=tuple(grounds))


def _ground(bed: BedGrid, material: Material, leaves: list[Leaf], paints: list[np.ndarray], lean: np.ndarray) -> Ground:
    """The bed and leaves that lean by ``lean`` (leaves, 2), painted in turn."""
    light, materials = Light(), [material]
    solids = tuple(leaf.solid(aside) for leaf, aside in zip(leaves, lean, strict=True))
    for number, solid in enumerate(solids):
        texture = _texture(solid, paints[number % len(paints)])
        materials.append(Material(texture, shade_of_normals(solid.normals, light)))
    return Ground(bed, solids, tuple(materials))


def _texture(solid: Solid, image: np.ndarray, texel_m: float = 0.008) -> ImageTexture:
    """A periodic speckle along the axes of local, as `survey.simulate.ground.ground` lays one."""
    axes = np.eye(3)[[[1, 2], [2, 0], [0, 1]]] / texel_m
    texel_from_point = np.concatenate([axes, np.zeros((3, 2, 1))], axis=-1)
    return ImageTexture(image, texel_from_point, np.abs(solid.normals).argmax(axis=1), repeats=True)
