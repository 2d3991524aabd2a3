"""Workers that share no disk with the run: all that a tile needs comes by its URL, and the cloud is the same."""

import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_runs import drawn
from s3_server import served
from small_survey import small_survey

from survey.errors import SurveyError
from survey.files.remote import Remote, local_run
from survey.folder.survey import load_survey
from survey.photos.images import ImageStore
from survey.plan.sweep_block import grey_image
from survey.progress import Progress
from survey.run import worker_task
from survey.run.process import process
from survey.run.remote_run import JOBS, PARTS, PHOTOGRAPHS
from survey.run.worker_task import Task, compute_task, save_job
from survey.stage_key import code_hash

pytest.importorskip("fsspec", reason="fsspec, of the extra `remote`, is not installed")


def test_a_task_fetches_what_it_needs_and_leaves_its_result_at_the_url(tmp_path, monkeypatch):
    survey = load_survey(small_survey(tmp_path / "survey"))
    remote = Remote(f"memory://{tmp_path.name}/run")
    (tmp_path / "adjust-1a").mkdir()
    (tmp_path / "adjust-1a" / "a.txt").write_text("needed")
    remote.put_folder(tmp_path / "adjust-1a", "stages/adjust-1a")
    block = SimpleNamespace(saturated=[0.0] * 4, images=None)
    job = SimpleNamespace(survey=survey, chosen=None, plan=None, bed_search=None, block=block)
    name = save_job(job, tmp_path, "sweep", remote)
    assert len(remote.files(PHOTOGRAPHS)) == 4
    seen = {}

    def job_of(survey, _chosen, _planned, _found, images, _saturated):
        plan, camera = SimpleNamespace(image_scale=1.0), survey.views[0].camera
        progress = SimpleNamespace(lines=[])
        whole = SimpleNamespace(survey=survey, plan=plan, cameras=[camera], progress=progress, release=lambda: None)
        windows = ([SimpleNamespace(view=1)], [SimpleNamespace(view=1), SimpleNamespace(view=2)])
        idle = {"release": lambda: None, "survey_job": whole, "images": images}
        whole.tiles = [SimpleNamespace(windows=each, **idle) for each in windows]
        return whole

    def compute(tile, folder, needs):
        (folder / "b.txt").write_text((needs["adjust"] / "a.txt").read_text())
        views = tile.survey_job.survey.views
        seen["here"] = [view.name for view in views if view.path.is_file()]
        seen["window"] = tile.images.window(1, slice(3, 9), slice(0, 64))

    monkeypatch.setattr(worker_task, "_job_of_parts", job_of)
    monkeypatch.setattr(worker_task, "_tile", lambda job, task: job.tiles[task.tile])
    for tile in (1, 0):
        task = Task(f"sweep_tile{tile}", tile, compute, {"adjust": Path("/not/here/adjust-1a")})
        place, _, _ = compute_task(name, remote.url, task, code_hash())
        assert remote.read(f"{place}/b.txt") == b"needed"
        # Those of the tile before are removed.
        assert seen["here"] == [survey.views[number].name for number in ((1,), (1, 2))[tile]]
    whole, _ = grey_image(survey.views[1], 1.0, (64, 48), ImageStore(0))
    np.testing.assert_array_equal(seen["window"], whole[3:9])
    # Photographs that are there are not put again.
    monkeypatch.setattr(Remote, "put", lambda _self, paths: seen.update(put=[*seen.get("put", []), *paths]))
    save_job(job, tmp_path, "solver", remote)
    assert [each.partition("/")[0] for each in seen["put"]] == [JOBS]
    with pytest.raises(SurveyError, match="is not there any more"):
        compute_task(f"{JOBS}/none", remote.url, task, code_hash())
    with pytest.raises(SurveyError, match="another version of bathynerf"):
        compute_task(name, remote.url, task, "0")


def test_photographs_at_a_url_are_fetched_from_there(tmp_path):
    survey, remote = load_survey(small_survey(tmp_path / "survey")), Remote(f"memory://{tmp_path.name}/run")
    config = replace(survey.config, images=replace(survey.config.images, dir="s3://bucket/flight"))
    place = survey.folder / config.images.local_dir
    shutil.copytree(survey.folder / "images", place)
    views = tuple(replace(view, path=place / view.name) for view in survey.views)
    found = worker_task._sources(replace(survey, config=config, views=views), remote)
    assert found == {view.path: ("s3://bucket/flight", view.name, "") for view in views}
    assert remote.files() == {}


def test_a_photograph_that_has_changed_at_the_url_during_a_run_is_refused(tmp_path):
    remote, path = Remote(f"memory://{tmp_path.name}/flight"), tmp_path / "a.jpg"
    path.write_bytes(b"before")
    remote.put({"a.jpg": path})
    source = remote.url, "a.jpg", remote.files()["a.jpg"]
    worker_task._require_same(remote, source, path)
    path.write_bytes(b"after it")
    remote.put({"a.jpg": path})
    with pytest.raises(SurveyError, match=r"flight/a\.jpg has changed since the run began .*run the same `bathynerf"):
        worker_task._require_same(remote, source, path)
    assert not path.exists()


def test_a_photograph_that_was_put_in_part_is_put_again(tmp_path):
    survey, remote = load_survey(small_survey(tmp_path / "survey")), Remote(f"memory://{tmp_path.name}/run")
    of_path = worker_task._sources(survey, remote)
    path, (_, name, _) = next(iter(of_path.items()))
    (tmp_path / "part").write_bytes(path.read_bytes()[:100])
    remote.put({name: tmp_path / "part"})
    worker_task._sources(survey, remote)
    assert remote.read(name) == path.read_bytes()


@pytest.mark.slow
def test_workers_that_see_only_the_url_leave_the_bytes_of_one_process(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    folder = tmp_path / "survey"
    drawn(folder, num_views=12)
    with Progress(verbosity=-1):
        assert process(folder, tmp_path / "alone", tiles=3, quality="draft") == 0
    with (
        served(monkeypatch) as bucket,
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, memory_limit=0, dashboard_address=None, silence_logs="ERROR"
        ) as cluster,
        Progress(verbosity=-1),
    ):
        url, address = f"{bucket}/run", cluster.scheduler_address
        assert process(folder, url, tiles=3, quality="draft", scheduler=address, workers=2) == 0
        there = Remote(url)
        assert there.read("cloud.las") == (tmp_path / "alone" / "cloud.las").read_bytes()
        assert [each for each in (JOBS, PARTS, PHOTOGRAPHS) if there.files(each)] == []
    assert os.path.lexists(local_run(folder, url) / "result.json")
