"""What a run stored of its cloud, and the files that are exported from it."""

from __future__ import annotations

import numpy as np
import pytest
from small_bed import plane_bed
from small_survey import small_survey

from geo import read_cloud, read_reference
from survey.errors import OutputError, SurveyError
from survey.folder.survey import load_survey
from survey.run.export import export
from survey.run.folder import RunDir
from survey.run.keys import Key
from survey.run.stored import StoredBed, load_bed, save_bed

# LAS steps by 1 mm: half a step, and the rounding of a northing of 5e6 m.
LAS_ROUNDING = 0.5e-3 + 1e-8
FLOAT_EPS = 1.2e-7


@pytest.fixture(scope="module")
def stored(tmp_path_factory) -> StoredBed:
    survey = load_survey(small_survey(tmp_path_factory.mktemp("survey") / "small"))
    bed = plane_bed(survey)
    return StoredBed(bed, survey.frame.crs_from_local(bed.xyz), survey.frame.crs, "Flußbett", 0.02)


@pytest.fixture(scope="module")
def run_folder(stored, tmp_path_factory):
    with RunDir(tmp_path_factory.mktemp("run") / "run") as run:
        folder = run.open_stage("bed")
        save_bed(folder, stored)
        folder = run.finish_stage("bed", Key({}), folder)
        run.publish(run.open_result("standard"), quality="standard", stages={"bed": folder})
    return run.path


def test_a_stored_bed_comes_back_to_the_bit(stored, run_folder):
    again = load_bed(RunDir(run_folder).load_stage("bed"))
    for name in ("xyz", "rgb", "std", "num_views", "depth", "incidence", "wet"):
        before, after = getattr(stored.bed, name), getattr(again.bed, name)
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(again.points_crs, stored.points_crs)
    assert again.crs.equals(stored.crs)
    assert (again.name, again.gsd_m) == ("Flußbett", 0.02)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_and_laz_have_the_points_their_crs_and_their_extra_bytes(stored, run_folder, tmp_path, suffix):
    path = tmp_path / f"out.{suffix}"
    assert export(run_folder, **{suffix: path}) == [path]
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.points, stored.points_crs, rtol=0.0, atol=LAS_ROUNDING)
    np.testing.assert_array_equal(cloud.rgb, stored.bed.rgb)
    np.testing.assert_array_equal(cloud.classification == 40, stored.bed.wet)
    np.testing.assert_allclose(cloud.extra["depth"], stored.bed.depth, rtol=FLOAT_EPS)
    np.testing.assert_allclose(cloud.extra["std"], stored.bed.std, rtol=FLOAT_EPS)
    np.testing.assert_array_equal(cloud.extra["num_views"], stored.bed.num_views)
    np.testing.assert_allclose(cloud.extra["incidence"], np.degrees(stored.bed.incidence), rtol=FLOAT_EPS)
    assert cloud.crs.sub_crs_list[0].to_epsg() == 25832


def test_ply_has_the_points_in_double_precision_and_the_scalars_with_their_units(stored, run_folder, tmp_path):
    export(run_folder, ply=tmp_path / "out.ply")
    cloud = read_reference(tmp_path / "out.ply")
    np.testing.assert_array_equal(cloud.points, stored.points_crs)
    np.testing.assert_array_equal(cloud.rgb, stored.bed.rgb)
    assert set(cloud.extra) == {"depth_m", "std_m", "std_common_m", "num_views", "incidence_deg"}
    np.testing.assert_allclose(cloud.extra["incidence_deg"], np.degrees(stored.bed.incidence), rtol=FLOAT_EPS)


def test_several_formats_are_written_at_once(run_folder, tmp_path):
    paths = [tmp_path / "a.las", tmp_path / "b.laz", tmp_path / "c.ply"]
    assert export(run_folder, las=paths[0], laz=paths[1], ply=paths[2]) == paths
    assert sorted(tmp_path.iterdir()) == paths
    assert paths[1].stat().st_size < paths[0].stat().st_size


def test_a_format_has_to_be_asked_for(run_folder):
    with pytest.raises(SurveyError, match=r"nothing to export was named; give at least one of --las"):
        export(run_folder)


def test_a_name_that_ends_otherwise_than_its_format_is_refused_before_anything_is_written(run_folder, tmp_path):
    with pytest.raises(SurveyError, match=r"--ply names .*out\.las; expected a name that ends in \.ply"):
        export(run_folder, las=tmp_path / "in.las", ply=tmp_path / "out.las")
    assert list(tmp_path.iterdir()) == []


def test_a_target_folder_that_does_not_exist_is_named(run_folder, tmp_path):
    with pytest.raises(OutputError, match=r"--las names .*missing/out\.las, whose folder does not exist"):
        export(run_folder, las=tmp_path / "missing" / "out.las")


@pytest.mark.parametrize("suffix", ["las", "laz", "ply"])
def test_an_earlier_export_is_replaced_and_nothing_else(run_folder, tmp_path, suffix):
    path = tmp_path / f"out.{suffix}"
    export(run_folder, **{suffix: path})
    first = path.read_bytes()
    path.write_bytes(first[:2000])
    export(run_folder, **{suffix: path})
    assert len(path.read_bytes()) == len(first)
    # A reference of the same format, and a file that only has the name.
    foreign = {"ply": b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"}
    for content in (foreign.get(suffix, b"LASF" + bytes(300)), b"bathynerf"):
        path.write_bytes(content)
        with pytest.raises(OutputError, match=rf"--{suffix} names .*out.*, which exists and is not a cloud"):
            export(run_folder, **{suffix: path})
        assert path.read_bytes() == content
        assert list(tmp_path.iterdir()) == [path]


def test_what_the_run_itself_needs_is_not_overwritten(stored, tmp_path):
    with RunDir(tmp_path / "run") as run:
        folder = run.open_stage("bed")
        save_bed(folder, stored)
        folder = run.finish_stage("bed", Key({}), folder)
        run.publish(run.open_result("standard"), quality="standard", stages={"bed": folder})
    export(run.path, las=tmp_path / "a.las")
    run.cloud_path.write_bytes((tmp_path / "a.las").read_bytes())
    (tmp_path / "link.las").symlink_to(run.cloud_path)
    for path in (run.cloud_path, tmp_path / "link.las"):
        with pytest.raises(OutputError, match=r"would overwrite the input .*run/cloud\.las"):
            export(run.path, las=path)


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(SurveyError, match=r"is no run folder; name the folder that process wrote"):
        export(tmp_path, las=tmp_path / "out.las")
    with pytest.raises(SurveyError, match=r"gone does not exist"):
        export(tmp_path / "gone", las=tmp_path / "out.las")


def test_a_run_that_has_not_come_to_its_cloud_is_refused_with_the_mend(tmp_path):
    with RunDir(tmp_path / "run") as run:
        run.finish_stage("sweep", Key({}), run.open_stage("sweep"))
    with pytest.raises(SurveyError, match=r"no finished stage bed; give the same `bathynerf process` again"):
        export(tmp_path / "run", las=tmp_path / "out.las")


@pytest.mark.parametrize("spoil", ["bed.npz", "survey.json"])
def test_a_damaged_bed_is_named_with_the_mend(stored, tmp_path, spoil):
    save_bed(tmp_path, stored)
    (tmp_path / spoil).write_text("{}")
    with pytest.raises(SurveyError, match=r"bathynerf process"):
        load_bed(tmp_path)
