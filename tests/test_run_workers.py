"""Tiles by worker processes: the cloud of one process, also where workers end on the way."""

import asyncio
import os
import pickle
import time
import urllib.error
import urllib.request
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from types import SimpleNamespace

import psutil
import pytest
from command_line import raising
from drawn_runs import drawn

from survey.errors import SurveyError
from survey.progress import Progress
from survey.run import workers as workers_module
from survey.run.folder import RunDir
from survey.run.process import process
from survey.run.worker_task import Task, compute_task, save_job
from survey.run.workers import WorkerNeeds, Workers, workers_for
from survey.stage_key import code_hash


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    return drawn(tmp_path_factory.mktemp("workers") / "survey", num_views=12)


@pytest.fixture(scope="module")
def in_one_process(survey):
    return points_of(survey, "one", workers=1)


def points_of(survey, name: str, workers: int) -> bytes:
    """What the bed of a run in three tiles holds."""
    folder = survey.folder.parent / name
    with Progress(verbosity=-1):
        assert process(survey.folder, folder, tiles=3, workers=workers) == 0
    run = RunDir(folder)
    assert f"plan: workers: {workers} (set by --workers)" in run.log_path.read_text(encoding="utf-8")
    assert not list(run.stages_path.glob(".*.part"))
    return (run.load_stage("bed") / "bed.npz").read_bytes()


@pytest.mark.slow
def test_workers_leave_the_bytes_of_one_process(survey, in_one_process):
    assert points_of(survey, "two", workers=2) == in_one_process


@pytest.mark.slow
def test_a_worker_that_is_killed_changes_nothing(survey, in_one_process):
    stages, ended, killed = survey.folder.parent / "killed" / "stages", Event(), []

    def kill() -> None:
        while not ended.is_set() and not killed:
            begun = list(stages.glob(".sweep_tile*.part")) or list(stages.glob(".solver_tile*.part"))
            for worker in workers_here() if begun else []:
                worker.kill()
                killed.append(worker.pid)
                break
            time.sleep(0.05)

    thread = Thread(target=kill)
    thread.start()
    try:
        assert points_of(survey, "killed", workers=2) == in_one_process
    finally:
        ended.set()
        thread.join()
    assert killed


def workers_here() -> list[psutil.Process]:
    """Processes that Dask has started from this one."""
    found = []
    for each in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            if "spawn_main" in " ".join(each.cmdline()) and each.children() == []:
                found.append(each)
    return found


def test_a_scheduler_that_does_not_answer_is_named(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("survey.run.workers.WORKER_TIMEOUT_S", 0.5)
    nowhere = "tcp://127.0.0.1:9"
    with (
        pytest.raises(SurveyError, match=rf"--scheduler {nowhere} gave no 1 workers within 0 s"),
        workers_for(1, nowhere, WorkerNeeds(tmp_path, tmp_path), print),
    ):
        pass


PLACE = "tcp://10.0.0.7:41"
TASKS = [Task(f"sweep_tile{number}", number, print, {}) for number in range(4)]
# Of a scheduler in this process: any, as others may run beside it.
FREE_PORTS = {"dashboard": False, "dashboard_address": "127.0.0.1:0", "protocol": "inproc://", "port": 0}


class ClientOfOne:
    """Client of a scheduler with one worker, which is this process or answers as it is told."""

    def __init__(self, threads: int = 1, answer: object = None):
        self.threads, self.answer, self.cancelled = threads, answer, None

    def nthreads(self):
        return {PLACE: self.threads}

    def run(self, function, *args, on_error):
        assert on_error == "return"
        return {PLACE: function(*args) if self.answer is None else self.answer}

    def scheduler_info(self):
        return {"workers": {PLACE: {}}}

    def cancel(self, futures):
        self.cancelled = futures


@pytest.fixture
def run_and_photograph(tmp_path):
    photograph = tmp_path / "a.jpg"
    photograph.touch()
    return tmp_path, photograph


def test_a_worker_that_is_as_it_should_be_passes(run_and_photograph):
    workers_module._check(ClientOfOne(), WorkerNeeds(*run_and_photograph))
    assert list(run_and_photograph[0].iterdir()) == [run_and_photograph[1]]


@pytest.mark.parametrize(
    ("worker", "said"),
    [
        ({"threads": 4}, "has 4 threads, expected one.*start it with --nthreads 1"),
        (
            {"answer": Exception("ModuleNotFoundError(\"No module named 'survey'\")")},
            "cannot load bathynerf .*No module named",
        ),
        ({"answer": ("0" * 64, True, True)}, "has another version of bathynerf.*install the same"),
        ({"answer": (code_hash(), False, True)}, "does not see .*name a run folder with -o"),
        ({"answer": (code_hash(), True, False)}, r"does not see .*a\.jpg; put the survey where"),
    ],
)
def test_a_worker_that_is_not_as_it_should_be_is_named(run_and_photograph, worker, said):
    with pytest.raises(SurveyError, match=f"the worker {PLACE} {said}"):
        workers_module._check(ClientOfOne(**worker), WorkerNeeds(*run_and_photograph))


def test_a_worker_that_does_not_reach_the_url_of_the_run_is_named(run_and_photograph):
    url = f"memory://{run_and_photograph[0].name}"
    workers_module._check(ClientOfOne(), WorkerNeeds(*run_and_photograph, url=url))
    client = ClientOfOne(answer=SurveyError("s3://bucket/run asks for keys, and there are none"))
    with pytest.raises(SurveyError, match=f"the worker {PLACE} finds that s3://bucket/run asks for keys"):
        workers_module._check(client, WorkerNeeds(*run_and_photograph, url="s3://bucket/run"))


@pytest.fixture
def started(run_and_photograph):
    """Workers that a run has started on this machine."""
    pytest.importorskip("distributed")
    with workers_for(1, None, WorkerNeeds(*run_and_photograph), print) as workers:
        yield workers


def test_nobody_without_the_key_of_the_run_reaches_its_scheduler_and_its_workers(started):
    distributed = pytest.importorskip("distributed")
    client = started._client
    places = [client.scheduler.address, *client.nthreads(), *(each["nanny"] for each in workers_info(client))]
    assert len(places) == 3
    assert all(place.startswith("tls://127.0.0.1:") for place in places)

    async def identity(place: str, **keys: object) -> object:
        async with distributed.rpc(place, timeout=5.0, **keys) as server:
            return await server.identity()

    for place in places:
        without, other = place.replace("tls:", "tcp:"), distributed.Security.temporary().get_connection_args("client")
        for address, keys in ((without, {}), (place, {"connection_args": other})):
            with pytest.raises(distributed.comm.core.CommClosedError):
                asyncio.run(identity(address, **keys))
        assert asyncio.run(identity(place, connection_args=client.security.get_connection_args("client")))["id"]


def workers_info(client) -> list[dict]:
    return list(client.scheduler_info()["workers"].values())


def test_what_dask_serves_by_http_has_no_page_and_is_of_this_machine_alone(started):
    me = psutil.Process()
    listening = [
        each.laddr
        for process in (me, *me.children(recursive=True))
        for each in process.net_connections(kind="tcp")
        if each.status == psutil.CONN_LISTEN
    ]
    assert len(listening) >= 4
    assert {address.ip for address in listening} == {"127.0.0.1"}
    dashboards = [started._client.scheduler_info()["services"]["dashboard"]]
    dashboards += [each["services"]["dashboard"] for each in workers_info(started._client)]
    for port in dashboards:
        for page in ("", "health", "metrics", "info/main/workers.html", "json/counts.json", "status", "sysmon"):
            with pytest.raises(urllib.error.HTTPError, match="404") as refused:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/{page}", timeout=10.0)
            refused.value.close()


def test_nobody_else_may_write_where_workers_import_from(started):
    [folder] = [Path(each["local_directory"]) for each in workers_info(started._client)]
    own = next(parent for parent in folder.parents if parent.name.startswith("bathynerf-"))
    assert own.stat().st_mode & 0o077 == 0


def test_a_scheduler_with_tls_is_reached_by_the_settings_of_dask(run_and_photograph):
    distributed = pytest.importorskip("distributed")
    import dask

    keys = distributed.Security.temporary()
    scheduler = {"cls": distributed.Scheduler, "options": FREE_PORTS | {"protocol": "tls://", "security": keys}}
    worker = {"cls": distributed.Worker, "options": {"nthreads": 1, "protocol": "tls://", "security": keys}}
    settings = {
        "distributed.comm.tls.ca-file": keys.tls_ca_file,
        "distributed.comm.tls.client.cert": keys.tls_client_cert,
        "distributed.comm.tls.client.key": keys.tls_client_key,
    }
    with distributed.SpecCluster(
        workers={0: worker}, scheduler=scheduler, security=keys, silence_logs="ERROR"
    ) as cluster:
        place = cluster.scheduler_address
        with dask.config.set(settings), workers_for(1, place, WorkerNeeds(*run_and_photograph), print) as workers:
            assert workers._client.scheduler.address == place
        with (
            pytest.raises(
                SurveyError, match=f"--scheduler {place} gave no 1 workers .* give Dask the keys of a tls://"
            ),
            workers_for(1, place, WorkerNeeds(*run_and_photograph), print),
        ):
            pass


def test_workers_of_this_machine_share_its_gpus(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2, GPU-8f")
    assert workers_module.gpus() == ["2", "GPU-8f"]
    distributed = SimpleNamespace(WorkerPlugin=object)
    monkeypatch.setattr("os.sched_setaffinity", lambda *_given: None, raising=False)
    found = []
    for name in ("0", "1", "2"):
        workers_module._cores_plugin(distributed, 3, ["2", "GPU-8f"]).setup(SimpleNamespace(name=name))
        found.append(os.environ["CUDA_VISIBLE_DEVICES"])
    assert found == ["2", "GPU-8f", "2"]


@pytest.mark.parametrize("lost", ["cancelled", "closed"])
def test_a_scheduler_that_is_lost_is_named(tmp_path, lost):
    comm = pytest.importorskip("distributed.comm.core")
    error = {"cancelled": CancelledError("scheduler-connection-lost"), "closed": comm.CommClosedError("is closed")}[
        lost
    ]
    client = ClientOfOne()
    client.submit = raising(error)
    with pytest.raises(SurveyError, match="scheduler of the workers was lost; 1 of 1 tiles are missing: start it"):
        list(Workers(client, tmp_path, are_started=False).computed(tmp_path, TASKS[:1]))
    assert client.cancelled is not None


def test_a_worker_that_ends_while_it_is_looked_at_is_left_out(run_and_photograph):
    class Leaving(ClientOfOne):
        def run(self, function, *args, on_error):
            self.nthreads = dict
            return {PLACE: OSError("Stream is closed")}

    workers_module._check(Leaving(), WorkerNeeds(*run_and_photograph))


def test_a_task_of_other_code_is_refused(tmp_path):
    with pytest.raises(SurveyError, match="has another version of bathynerf than the run"):
        compute_task(tmp_path / "job.pickle", tmp_path, TASKS[1], "of the run")


def test_each_job_is_saved_under_a_name_of_its_own_with_absolute_paths(shallow_survey, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    view = replace(shallow_survey.views[0], path=Path("images/a.jpg"), mask_path=Path("masks/a.png"))
    survey = replace(shallow_survey, views=(view,))
    block = SimpleNamespace(images=[], saturated=[])
    job = SimpleNamespace(survey=survey, chosen=None, plan=None, bed_search=None, block=block)
    first, second = (save_job(job, tmp_path, "sweep") for _ in range(2))
    assert first != second
    stored = pickle.loads(Path(second).read_bytes())[0][0].views[0]
    assert (stored.path, stored.mask_path) == (tmp_path / "images" / "a.jpg", tmp_path / "masks" / "a.png")


@pytest.fixture(scope="module")
def two_workers():
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        client.wait_for_workers(2, timeout=60)
        yield client


class Computing(Workers):
    """Workers whose tasks are a function of these tests; costs of the tasks as they begin."""

    def __init__(self, client, function, *, are_started=True):
        super().__init__(client, Path(), are_started=are_started)
        self.function, self.begun = function, []

    def _submit(self, job, task):
        self.begun.append(task.cost)
        return self._client.submit(self.function, task, pure=False)


HELD: list[int] = []


def recorded(task):
    """Record how many tasks the worker holds beside this one."""
    from distributed import get_worker

    HELD.append(len(get_worker().state.ready))
    time.sleep(0.02)
    return Path(task.name), 0.0, []


def test_tasks_begin_by_cost_where_a_worker_is_free_and_none_waits_at_another(two_workers):
    workers, costs = Computing(two_workers, recorded), [3, 9, 1, 7, 5, 2, 8, 6]
    tasks = [replace(TASKS[0], name=f"sweep_tile{number}", cost=cost) for number, cost in enumerate(costs)]
    places = {number: place for number, place, *_ in workers.computed("job", tasks)}
    assert places == {n: Path(f"sweep_tile{n}") for n in range(len(costs))}
    assert workers.begun == sorted(costs, reverse=True)
    assert set(HELD) == {0}


def without_disk(task):
    raise SurveyError(f"{task.name} cannot be written (No space left on device)")


def killed(task):
    from distributed import KilledWorker

    raise KilledWorker(task.name, SimpleNamespace(address="here"), 1)


@pytest.mark.parametrize(
    ("function", "are_started", "said"),
    [
        (without_disk, True, "No space left on device"),
        (killed, True, r"sweep_tile\d: 2 workers that computed it .* fewer --workers, or more --tiles$"),
        (killed, False, r"sweep_tile\d: 2 workers that computed it .* with more --tiles$"),
    ],
)
def test_an_error_of_a_worker_and_a_task_that_ends_its_workers_end_the_run(two_workers, function, are_started, said):
    with pytest.raises(SurveyError, match=said):
        list(Computing(two_workers, function, are_started=are_started).computed("job", TASKS))


def test_a_script_that_is_run_again_by_its_processes_is_told_how_to_stand():
    start = raising(RuntimeError("Nanny failed to start."))
    distributed = SimpleNamespace(LocalCluster=start, Security=SimpleNamespace(temporary=object))
    with pytest.raises(SurveyError, match='`if __name__ == "__main__":` around what it does; else take workers=1'):
        workers_module._local_cluster(distributed, 2, "/tmp")


# Set when the other worker has computed five of six tasks, which is all that one slow worker leaves it.
OTHERS_ARE_DONE, COMPUTED = Event(), []


def slow_on_one(task):
    from distributed import get_worker

    name = get_worker().name
    if name == "slow":
        assert OTHERS_ARE_DONE.wait(60.0)
    COMPUTED.append(name)
    if COMPUTED.count("fast") == 5:
        OTHERS_ARE_DONE.set()
    return Path(task.name), 0.0, []


def test_a_slow_worker_holds_up_no_task_but_its_own():
    distributed = pytest.importorskip("distributed")
    workers = {name: {"cls": distributed.Worker, "options": {"nthreads": 1, "name": name}} for name in ("slow", "fast")}
    scheduler = {"cls": distributed.Scheduler, "options": FREE_PORTS}
    with (
        distributed.SpecCluster(workers=workers, scheduler=scheduler, asynchronous=False) as cluster,
        distributed.Client(cluster) as client,
    ):
        tasks = [Task(f"sweep_tile{number}", number, print, {}) for number in range(6)]
        numbers = {number for number, *_ in Computing(client, slow_on_one).computed("job", tasks)}
    assert numbers == set(range(6))
    assert COMPUTED.count("slow") == 1


class ClientOfThisProcess(ClientOfOne):
    """Client whose worker computes at once, or fails."""

    def __init__(self, error: Exception | None = None):
        super().__init__()
        self.error, self.submitted = error, 0

    def submit(self, function, *given, pure):
        assert not pure
        self.submitted += 1
        compute = function if self.error is None else raising(self.error)
        return SimpleNamespace(result=lambda: compute(*given))


def test_a_function_of_many_items_keeps_their_order_and_a_few_under_way(tmp_path):
    client = ClientOfThisProcess()
    found = Workers(client, tmp_path, are_started=False).map(lambda item: 10 * item, range(20))
    assert next(found) == 0
    assert client.submitted < 10
    assert list(found) == [10 * item for item in range(1, 20)]
    assert client.cancelled == []


def test_what_a_worker_cannot_read_the_process_of_the_run_does(tmp_path):
    client = ClientOfThisProcess(OSError(28, "No space left on device"))
    assert list(Workers(client, tmp_path, are_started=False).map(abs, [-1, -2])) == [1, 2]


def test_a_scheduler_that_is_lost_during_structure_from_motion_is_named(tmp_path):
    client = ClientOfThisProcess(CancelledError("scheduler-connection-lost"))
    with pytest.raises(SurveyError, match="was lost during structure from motion; start it"):
        list(Workers(client, tmp_path, are_started=False).map(abs, [-1, -2]))
    assert len(client.cancelled) == 1
