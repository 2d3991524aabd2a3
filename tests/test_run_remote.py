"""A run at a URL: what one machine has finished another takes up, and a result is there whole or not at all."""

import shutil
from contextlib import contextmanager

import pytest
from drawn_runs import drawn
from s3_server import served
from test_run_folder import A, B, contents, finish, publish

from survey.errors import SurveyError
from survey.files.json_values import write_json
from survey.files.remote import Remote, local_run
from survey.progress import Progress
from survey.run.folder import Owner, RunDir
from survey.run.process import process
from survey.run.remote_run import RemoteRun

pytest.importorskip("fsspec", reason="fsspec, of the extra `remote`, is not installed")


@pytest.fixture
def url(tmp_path):
    return f"memory://{tmp_path.name}/run"


def test_what_one_machine_has_finished_another_takes_up(url, tmp_path):
    with RemoteRun(tmp_path / "laptop", Remote(url)) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
        folder = finish(run, "sweep", A, heights=[1.0, 2.0])
    with RemoteRun(tmp_path / "cluster", Remote(url)) as run:
        assert run.finished_stage("sweep", B, ["data.npz"]) is None
        found = run.finished_stage("sweep", A, ["data.npz"])
        assert found == run.path / "stages" / folder.name
        assert (found / "data.npz").read_bytes() == (folder / "data.npz").read_bytes()
        assert run.owner() == Owner("quick", {"a.jpg": 1})


def test_poses_of_structure_from_motion_go_along(url, tmp_path):
    with RemoteRun(tmp_path / "laptop", Remote(url)) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
        (run.sfm_path / "model").mkdir(parents=True)
        (run.sfm_path / "model" / "0.bin").write_text("poses")
        (run.sfm_path / "solved.json").write_text('{"key": "k"}')
        finish(run, "sweep", A, heights=[1.0])
    with RemoteRun(tmp_path / "cluster", Remote(url)) as run:
        assert (run.sfm_path / "model" / "0.bin").read_text() == "poses"
        assert (run.sfm_path / "solved.json").read_text() == '{"key": "k"}'


@contextmanager
def losing(monkeypatch, remote: Remote, move: str, end: str):
    """The connection is lost where a file whose name ends so is moved."""
    moved = getattr(remote, move)

    def lost(file):
        if file[0].endswith(end):
            raise SurveyError("was not reached")
        moved(file)

    with monkeypatch.context() as patch:
        patch.setattr(remote, move, lost)
        yield


def test_poses_that_came_in_part_are_fetched_again_and_replace_others(url, tmp_path, monkeypatch):
    with RemoteRun(tmp_path / "laptop", Remote(url)) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
        (run.sfm_path / "model").mkdir(parents=True)
        (run.sfm_path / "model" / "z.bin").write_text("poses")
        (run.sfm_path / "solved.json").write_text('{"key": "k"}')
        finish(run, "sweep", A, heights=[1.0])
    remote, other = Remote(url), tmp_path / "cluster" / "sfm"
    with losing(monkeypatch, remote, "_fetch", "z.bin"), pytest.raises(SurveyError, match="not reached"):
        RemoteRun(tmp_path / "cluster", remote).__enter__()
    assert not (other / "solved.json").exists()
    # Of other photographs.
    (other / "model").mkdir(parents=True)
    for name in ("solved.json", "model/1.bin"):
        (other / name).write_text("other")
    with RemoteRun(tmp_path / "cluster", remote) as run:
        finish(run, "sweep", B, heights=[2.0])
    names = ["model/z.bin", "solved.json"]
    assert sorted(path.relative_to(other).as_posix() for path in other.rglob("*") if path.is_file()) == names
    assert list(remote.files("sfm")) == names


def test_a_stage_that_is_put_again_is_not_whole_until_it_is_there(url, tmp_path, monkeypatch):
    def computed(run, **texts):
        temp = run.open_stage("sweep")
        for name, text in texts.items():
            (temp / f"{name}.txt").write_text(text)
        return run.finish_stage("sweep", A, temp)

    remote = Remote(url)
    with RemoteRun(tmp_path / "laptop", remote) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
        folder = computed(run, a="old", b="old", c="old")
        with losing(monkeypatch, remote, "_put", "b.txt"), pytest.raises(SurveyError, match="not reached"):
            computed(run, a="new", b="new")
    with RemoteRun(tmp_path / "cluster", remote) as run:
        assert run.finished_stage("sweep", A) is None
    with RemoteRun(tmp_path / "laptop", remote) as run:
        assert run.finished_stage("sweep", A) == folder
    assert set(remote.files(f"stages/{folder.name}")) == {"a.txt", "b.txt", "stage.json"}


def test_a_stage_without_its_record_is_not_taken_up(url, tmp_path):
    with RemoteRun(tmp_path / "laptop", Remote(url)) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
        folder = finish(run, "sweep", A, heights=[1.0])
        # The connection was lost before the record was put.
        run.remote.remove([f"stages/{folder.name}/stage.json"])
    with RemoteRun(tmp_path / "cluster", Remote(url)) as run:
        assert run.finished_stage("sweep", A) is None
    with RemoteRun(tmp_path / "laptop", Remote(url)) as run:
        assert run.finished_stage("sweep", A) == folder
        assert f"stages/{folder.name}/stage.json" in run.remote.files()


def test_a_stage_here_that_is_not_whole_is_fetched_again(url, tmp_path):
    with RemoteRun(tmp_path / "laptop", Remote(url)) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
        folder = finish(run, "sweep", A, heights=[1.0])
        (folder / "data.npz").unlink()
        assert run.finished_stage("sweep", A, ["data.npz"]) == folder
        assert (folder / "data.npz").is_file()


def test_the_number_of_tiles_that_a_run_began_with_is_known_elsewhere(url, tmp_path):
    with RemoteRun(tmp_path / "laptop", Remote(url)) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
        temp = run.open_stage("tiles")
        write_json(temp / "shared.json", {"tiles": 6})
        run.finish_stage("tiles", A, temp)
    with RemoteRun(tmp_path / "cluster", Remote(url)) as run:
        # One that is not whole does not count.
        write_json(tmp_path / "shared.json", {"tiles": 8})
        run.remote.put({"stages/tiles-zz/shared.json": tmp_path / "shared.json"})
        assert run.latest_stage_json("shared.json") == {"tiles": 6}
        assert run.latest_stage_json("other.json") == {}


def test_a_result_replaces_the_one_before_and_a_copy_of_the_url_is_a_run(url, tmp_path):
    remote = Remote(url)
    with RemoteRun(tmp_path / "laptop", remote) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
        first = finish(run, "sweep", A, heights=[1.0])
        publish(run, "draft", quality="draft", sweep=first)
    with RemoteRun(tmp_path / "cluster", remote) as run:
        second = finish(run, "sweep", B, heights=[2.0])
        finish(run, "adjust", B, heights=[2.0])
        publish(run, "fine", quality="fine", sweep=second)
    remote.fetch({name: tmp_path / "copy" / name for name in remote.files()})
    with pytest.raises(SurveyError, match=r"s3:/bucket/run is a URL; copy the run to this machine, and name the copy"):
        RunDir("s3://bucket/run").require_run()
    copy = RunDir(tmp_path / "copy")
    copy.require_run()
    assert contents(copy) == {"fine"}
    # That of the other quality, which another machine made, is kept; what belongs to no result is not.
    assert {path.name for path in copy.stages_path.iterdir()} == {first.name, second.name}
    assert copy.result()["others"] == {"draft": {"sweep": first.name}}


def test_a_result_leaves_what_another_run_has_begun(url, tmp_path):
    remote = Remote(url)
    (tmp_path / "a.pickle").touch()
    with RemoteRun(tmp_path / "laptop", remote) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
        run.open_result("draft")
        begun = finish(run, "sweep", A, heights=[1.0])
        remote.put({".jobs/a.pickle": tmp_path / "a.pickle"})
    with RemoteRun(tmp_path / "cluster", remote) as run:
        publish(run, "fine", quality="fine", sweep=finish(run, "sweep", B, heights=[2.0]))
    assert f"stages/{begun.name}/stage.json" in remote.files()
    assert ".jobs/a.pickle" in remote.files()
    # One of the same quality stands in for it.
    with RemoteRun(tmp_path / "other", remote) as run:
        publish(run, "draft", quality="draft")
    assert not {name for name in remote.files() if name.startswith((f"stages/{begun.name}", ".jobs", ".unfinished"))}


def test_of_two_results_of_another_quality_that_at_the_url_is_kept(url, tmp_path):
    remote = Remote(url)
    with RemoteRun(tmp_path / "laptop", remote) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
        publish(run, "early", quality="draft", sweep=finish(run, "sweep", A, heights=[1.0]))
    with RemoteRun(tmp_path / "cluster", remote) as run:
        late = finish(run, "sweep", B, heights=[2.0])
        publish(run, "late", quality="draft", sweep=late)
    with RemoteRun(tmp_path / "laptop", remote) as run:
        publish(run, "fine", quality="fine")
    assert f"stages/{late.name}/stage.json" in remote.files()
    assert run.result()["others"] == {"draft": {"sweep": late.name}}


def test_a_result_that_is_being_put_does_not_count(url, tmp_path, monkeypatch):
    remote = Remote(url)
    with RemoteRun(tmp_path / "laptop", remote) as run:
        publish(run, "draft", quality="draft")
        assert remote.read("result.json") is not None
        put = remote._put

        def lost(file):
            if file[0] == "cloud.las":
                raise SurveyError("was not reached")
            put(file)

        monkeypatch.setattr(remote, "_put", lost)
        with pytest.raises(SurveyError, match="not reached"):
            publish(run, "draft again", quality="draft")
    assert remote.read("result.json") is None


def test_a_place_that_holds_something_else_is_left_alone(url, tmp_path):
    remote = Remote(url)
    (tmp_path / "thesis.txt").touch()
    remote.put({"thesis.txt": tmp_path / "thesis.txt"})
    with pytest.raises(SurveyError, match=r"is not empty and is no run \(it has thesis\.txt\); name a new or empty"):
        RemoteRun(tmp_path / "laptop", remote).__enter__()
    other = Remote(f"{url}2")
    with RemoteRun(tmp_path / "laptop2", other) as run:
        run.claim(Owner("quick", {"a.jpg": 1}), is_inside=True)
    with RemoteRun(tmp_path / "cluster2", other) as run:
        (run.path / "log.txt").write_text("of shore")
        with pytest.raises(SurveyError, match=rf"the run folder {url}2 belongs to another survey, quick"):
            run.claim(Owner("shore", {"b.jpg": 2}), is_inside=True)
    assert other.read("log.txt") is None


@pytest.mark.slow
def test_a_run_that_was_interrupted_goes_on_from_s3_on_another_machine(tmp_path, monkeypatch):
    """Photographs and run lie in a bucket; the second machine has the settings and poses alone."""
    laptop, cluster = tmp_path / "laptop", tmp_path / "cluster"
    drawn(laptop)
    with Progress(verbosity=-1):
        assert process(laptop, tmp_path / "alone", quality="draft", tiles=2) == 0
    with served(monkeypatch) as bucket:
        Remote(bucket).put_folder(laptop / "images", "flight")
        shutil.rmtree(laptop / "images")
        toml = (laptop / "survey.toml").read_text()
        (laptop / "survey.toml").write_text(f'{toml}\n[images]\ndir = "{bucket}/flight"\n')
        shutil.copytree(laptop, cluster)
        url, finish_stage = f"{bucket}/run", RemoteRun.finish_stage

        def stopped(run, name, *given):
            place = finish_stage(run, name, *given)
            if name == "sweep_tile1":
                raise KeyboardInterrupt
            return place

        with pytest.MonkeyPatch.context() as patch, Progress(verbosity=-1):
            patch.setattr(RemoteRun, "finish_stage", stopped)
            with pytest.raises(KeyboardInterrupt):
                process(laptop, url, quality="draft", tiles=2)
        with Progress(verbosity=-1):
            assert process(cluster, url, quality="draft", tiles=2) == 0
        there = Remote(url)
        assert there.read("cloud.las") == (tmp_path / "alone" / "cloud.las").read_bytes()
        log = there.read("log.txt").decode()
    assert "sweep_tile1: used again" in log
    assert (local_run(cluster, url) / "result.json").is_file()
