"""The mappers of structure from motion: the same poses of a drawn block by each of them, and their choice."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from geo.similarity import fit_similarity
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Adjustment
from survey.errors import ConfigError
from survey.sfm import block as sfm_block
from survey.sfm import settings as sfm_settings
from survey.sfm.mapping import Matched, mapped
from survey.sfm.settings import mapper_of, require_mapper
from survey.words import Mapper
from tests.drawn_block import DrawnBlock, draw_block
from tests.drawn_matches import names_of, survey_of_mapped, write_matches

MAPPERS = [mapper for mapper in Mapper if mapper != Mapper.auto]
_NUM = 20


@pytest.fixture(scope="module")
def block() -> DrawnBlock:
    return draw_block(
        3, num_points=1200, num_views=_NUM, nadir_only=True, num_control=0, dry_share=0.0, height=25.0, depth=2.0,
        pixel_std=0.3, wrong=0.02, spacing=0.3,
    )  # fmt: skip


@pytest.fixture(scope="module")
def matched(block, tmp_path_factory) -> Matched:
    work = tmp_path_factory.mktemp("matches")
    write_matches(block, work / "database.db")
    return Matched(work / "database.db", work, work, _NUM)


@pytest.fixture(scope="module")
def one_by_one(matched, block, tmp_path_factory) -> Adjustment:
    return adjusted(block, blocks_by(matched, Mapper.incremental, tmp_path_factory.mktemp("one")))


def blocks_by(matched: Matched, mapper: str, work: Path) -> list[pycolmap.Reconstruction]:
    """Blocks by a mapper, from a copy of the matches."""
    shutil.copy(matched.database, work / "database.db")
    return mapped(Matched(work / "database.db", work, work, matched.num), mapper)


def adjusted(block: DrawnBlock, blocks: list[pycolmap.Reconstruction]) -> Adjustment:
    return adjust_survey(survey_of_mapped(block, blocks)[0], use_windows=False)


def centres_of(blocks: list[pycolmap.Reconstruction]) -> np.ndarray:
    return np.array([centre for centre, _ in sfm_block.poses_of(blocks[0]).values()])


@pytest.mark.parametrize("mapper", MAPPERS)
def test_after_the_adjustment_the_poses_are_the_same_whichever_mapper_found_them(
    block, matched, one_by_one, tmp_path, mapper
):
    blocks = blocks_by(matched, mapper, tmp_path)
    assert list(sfm_block.poses_of(blocks[0])) == names_of(block)
    true = np.array([camera.centre for camera in block.cameras])
    centres = centres_of(blocks)
    # Rays that are taken for straight bend a block 25 m over 2 m of water by as much as this.
    assert np.abs(fit_similarity(centres, true)(centres) - true).max() < 0.25
    found = adjusted(block, blocks)
    # Mappers differ in the matches that they take for wrong: by about as much as noise, whose std is stated (18 mm).
    std = np.median(found.poses.position_std)
    assert np.abs(found.poses.centres - one_by_one.poses.centres).max() < 2.0 * std
    assert np.abs(found.poses.centres - true).max() < 4.0 * std


@pytest.mark.parametrize("mapper", MAPPERS)
def test_a_mapper_finds_the_same_poses_again(matched, tmp_path, mapper):
    first, second = (centres_of(blocks_by(matched, mapper, tmp_path)) for _ in range(2))
    # Sums of two threads end in other digits; other random numbers would move global positions by millimetres.
    assert np.abs(first - second).max() < 1e-6 * np.ptp(first)


def test_the_size_of_a_block_chooses_its_mapper():
    assert mapper_of(10, Mapper.auto)[0] == Mapper.incremental


@pytest.mark.parametrize("mapper", MAPPERS)
def test_a_mapper_that_is_asked_for_is_taken(mapper):
    assert mapper_of(10, mapper) == (mapper, "set by [cameras] mapper in survey.toml")


def test_a_mapper_that_the_installed_pycolmap_lacks_is_refused_in_a_sentence(monkeypatch):
    monkeypatch.setattr(sfm_settings, "solver", lambda: SimpleNamespace(incremental_mapping=None))
    require_mapper(Mapper.auto)
    require_mapper(Mapper.incremental)
    with pytest.raises(ConfigError, match=r'mapper is "global" in survey.toml, and pycolmap 4\S+ does not have it'):
        require_mapper(Mapper.global_)
