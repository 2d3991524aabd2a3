"""Surveys drawn at random, one for each seed: other depths, flights, indices, beds, sensors and waves.

What a figure is tuned on and reported on is one survey; these are the others. Ranges are those of small drones over
shallow water; the photographs are small, so that a survey is drawn and processed in a minute.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from stress_changes import blur, compressed, contrast, exposure, images, noise
from stress_scenes import with_waves

from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.ground.ground import Ground, Material, shade_of_map
from survey.simulate.ground.shapes import BedGrid
from survey.simulate.ground.textures import light_of_bed
from survey.simulate.ground.textures import noise as smooth_noise
from survey.simulate.light import Light
from survey.simulate.output.sidecars import StagedScene
from survey.simulate.output.writing import write_survey

SIZES_PX = ((320, 240), (400, 300), (480, 360))
# Vertices of the bed to a ground sampling distance, so that it goes on below the pixel.
FINE = 3.0
# Relief of a drawn bed is this share of its spacing and ends at 5 cm; what is added begins here [m] and goes on below.
_SHARE, _ADDED_M = 0.05, 0.1
# What is done to photographs: the lowest and the highest value, and whether a factor between them is drawn.
CHANGES: dict[str, tuple[Callable[[Path, float], None], float, float]] = {
    "noise": (images(noise), 3.0, 12.0),
    "blur": (images(blur), 0.6, 2.2),
    "JPEG": (compressed, 20.0, 80.0),
    "contrast": (images(contrast), 0.1, 0.5),
    "exposure": (images(exposure), 0.1, 0.4),
}


@dataclass(frozen=True)
class RandomSurvey:
    """What a seed stands for.

    Attributes
    ----------
    scene : DrawnScene
    relief : [-]
        What is added below 10 cm, as a multiple of what larger relief leads to expect.
    waves_m : [m]
        Amplitude; 0 for still water.
    change : str or None
        One of `CHANGES`.
    value : float
        Of the change.
    """

    scene: DrawnScene
    relief: float
    waves_m: float
    change: str | None
    value: float

    @classmethod
    def of(cls, seed: int) -> RandomSurvey:
        """The survey of a seed."""
        rng = np.random.default_rng([seed, 778])
        depth = _between(rng, 0.5, 6.0)
        flying = max(float(rng.uniform(8.0, 25.0)), 2.2 * depth)
        size_px = SIZES_PX[rng.integers(len(SIZES_PX))]
        focal = float(size_px[0] * rng.uniform(1.2, 2.0))
        gsd, views = flying / focal, int(rng.integers(7, 23))
        side = float(np.clip(0.33 * size_px[0] * gsd * math.sqrt(views), 3.0, 14.0))
        scene = DrawnScene(
            size_m=(side, 0.9 * side),
            depth_m=depth,
            n_water=float(rng.uniform(1.32, 1.35)),
            level_m=float(rng.uniform(-5.0, 500.0)),
            num_views=views,
            nadir_share=float(rng.choice([0.3, 0.6, 1.0])),
            image_px=size_px,
            focal_px=focal,
            flying_m=flying,
            noise=_between(rng, 0.5, 4.0),
            seed=seed,
            cell_m=min(gsd / FINE, 0.025),
            texel_m=min(0.4 * gsd, 0.01),
            shore=bool(rng.random() < 0.35),
            objects=bool(rng.random() < 0.7),
        )
        waves = _between(rng, 0.001, 0.01) if rng.random() < 0.3 else 0.0
        change = [None, *CHANGES][rng.integers(1 + len(CHANGES))]
        value = 0.0 if change is None else _between(rng, *CHANGES[change][1:])
        return cls(scene, _between(rng, 0.25, 3.0), waves, change, value)

    def __str__(self) -> str:
        scene = self.scene
        words = [
            f"{scene.depth_m:.1f} m",
            f"{scene.num_views} views, {round(100 * scene.nadir_share)} % down",
            f"{1e3 * scene.flying_m / scene.focal_px:.0f} mm a pixel",
            f"relief x {self.relief:.2g}",
            f"noise {scene.noise:.1f}",
            *(["shore"] if scene.shore else []),
            *(["boat, rocks"] if scene.objects else []),
            *([f"waves of {1e3 * self.waves_m:.0f} mm"] if self.waves_m else []),
            *([f"then {self.change} {self.value:.2g}"] if self.change else []),
        ]
        return ", ".join(words)

    def draw(self, folder: Path) -> None:
        """Write the survey, with its truth, into a folder; what was there goes."""
        shutil.rmtree(folder, ignore_errors=True)
        write_survey(folder, asdict(self.scene), self._staged)
        if self.change is not None:
            CHANGES[self.change][0](folder, self.value)

    def _staged(self) -> StagedScene:
        staged = _rougher(stage_drawing(self.scene), self.relief)
        return with_waves(staged, self.waves_m) if self.waves_m else staged


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """As likely in each factor of two."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def _rougher(scene: StagedScene, relief: float) -> StagedScene:
    """The same bed with more relief below 10 cm, down to its cells."""
    ground = scene.renderer.ground
    bed, rng = ground.bed, np.random.default_rng([scene.seed, 34])
    assert isinstance(bed, BedGrid)
    heights, spacing = bed.heights.copy(), _ADDED_M
    while spacing >= bed.cell:
        heights += relief * _SHARE * spacing * smooth_noise(rng, heights.shape, spacing / bed.cell)
        spacing *= 0.5
    rough = BedGrid(heights, bed.west, bed.south, bed.cell)
    material = Material(ground.materials[0].texture, shade_of_map(rough, light_of_bed(rough, ground.solids, Light())))
    ground = Ground(rough, ground.solids, (material, *ground.materials[1:]))
    return replace(scene, renderer=replace(scene.renderer, ground=ground))
