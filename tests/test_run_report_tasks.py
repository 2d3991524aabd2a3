"""Pictures of a report drawn by worker processes."""

from __future__ import annotations

import pickle
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from small_bed import plane_bed, plane_height_map
from small_report import facts_of, load_shallow_survey

from survey.display.quantities import lengths_in_feet
from survey.report.pictures import draw_pictures
from survey.run import report_tasks
from survey.run.report_tasks import draw_on
from survey.run.stored import StoredBed, load_bed, mapped_arrays, save_arrays, save_bed


class PickledCalls:
    """Workers of this process that get what they compute as bytes."""

    def submit(self, function, *given):
        function, given = pickle.loads(pickle.dumps((function, given)))
        return lambda: function(*given)

    def on_each(self, function):
        function()


@pytest.fixture(scope="module")
def facts(tmp_path_factory):
    """Facts of a run whose points lie on the disk."""
    survey = load_shallow_survey(tmp_path_factory.mktemp("survey"))
    found = facts_of(survey, plane_bed(survey), height_maps=[plane_height_map(survey, 1)])
    folder = tmp_path_factory.mktemp("bed")
    save_bed(folder, StoredBed(found.bed, found.points_crs, survey.frame.crs, survey.name, 0.05))
    stored = load_bed(folder)
    return replace(found, bed=stored.bed, points_crs=stored.points_crs)


def test_workers_draw_the_same_pictures(facts, tmp_path):
    """In feet, which a worker has to be told."""
    report = replace(facts.survey.config.report, units="feet")
    facts = replace(facts, survey=replace(facts.survey, config=replace(facts.survey.config, report=report)))
    alone, together = tmp_path / "alone", tmp_path / "together"
    for folder in (alone, together):
        folder.mkdir()
    with lengths_in_feet(0.3048):
        expected = list(draw_pictures(alone, facts))
    found = list(draw_on(PickledCalls(), tmp_path, together, facts))
    assert [(each.title, each.caption) for each in found] == [(each.title, each.caption) for each in expected]
    assert [each.path for each in found] == [together / each.path.name for each in expected]
    assert report_tasks._drawings.cache_info().currsize == 0
    for picture in expected:
        assert (together / picture.path.name).read_bytes() == picture.path.read_bytes()


def test_columns_on_the_disk_are_pickled_as_references(rng, tmp_path):
    path, there = tmp_path / "columns.npz", np.asfortranarray(rng.normal(size=(1000, 3)))
    save_arrays(path, whole=there, empty=np.zeros((0, 3)))
    mapped = mapped_arrays(path)
    parts = mapped["whole"][5:10], np.asarray(mapped["whole"].base[5:8])
    stream = BytesIO()
    report_tasks._Pickler(stream).dump((mapped, parts))
    assert len(stream.getvalue()) < 2000
    found, found_parts = pickle.loads(stream.getvalue())
    np.testing.assert_array_equal(found["whole"], there)
    np.testing.assert_array_equal(found_parts[0], there[5:10])
    np.testing.assert_array_equal(found_parts[1], there[5:8])
    assert found["empty"].shape == (0, 3)
