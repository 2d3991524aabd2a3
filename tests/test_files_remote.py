"""Folders at URLs: what is put is fetched as it was, and what does not go ends in a sentence."""

import errno

import pytest
from command_line import raising
from s3_server import served

from geo.errors import UnwritableFile
from survey.errors import SurveyError
from survey.files.remote import Remote, is_url, local_name, local_run

fsspec = pytest.importorskip("fsspec", reason="fsspec, of the extra `remote`, is not installed")
from fsspec.implementations.memory import MemoryFileSystem  # noqa: E402


@pytest.fixture(params=["file", "memory", "s3"])
def url(request, tmp_path, monkeypatch):
    if request.param == "s3":
        with served(monkeypatch) as bucket:
            yield f"{bucket}/run"
        return
    yield f"file://{tmp_path}/there/run" if request.param == "file" else f"memory://{tmp_path.name}/run"


class Recording(Remote):
    """A folder at a URL, and the names that were put there in their order."""

    def _put(self, file):
        vars(self).setdefault("order", []).append(file[0])
        super()._put(file)


class Store(MemoryFileSystem):
    """A store of which one instance is not that of others with its URL: what it answers is given."""

    cachable = False


def store_of(remote: Remote, **answers) -> Remote:
    """The remote with a store of its own, and functions of it."""
    remote._store = Store()
    vars(remote._store).update(answers)
    return remote


def test_a_folder_is_fetched_as_it_was_put_and_its_mark_is_put_last(url, tmp_path):
    here, back = tmp_path / "here", tmp_path / "back"
    for name, text in (("a.txt", "first"), ("deep/b.bin", "second"), ("stage.json", "{}")):
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        (here / name).write_text(text)
    remote = Recording(url)
    assert remote.files() == {}
    assert remote.read("stages/a/stage.json") is None
    remote.put_folder(here, "stages/a", last="stage.json")
    assert remote.order[-1] == "stages/a/stage.json"
    # A folder beside it whose name begins alike is another one.
    Remote(f"{url}2").put({"else.txt": here / "a.txt"})
    assert set(remote.files()) == {"stages/a/a.txt", "stages/a/deep/b.bin", "stages/a/stage.json"}
    assert set(remote.files("stages/a/deep")) == {"b.bin"}
    remote.fetch_folder("stages/a", back)
    assert [(back / name).read_text() for name in ("a.txt", "deep/b.bin", "stage.json")] == ["first", "second", "{}"]
    before = remote.files()
    assert {name: remote.tag(name) for name in (*before, "none")} == before | {"none": None}
    (here / "a.txt").write_text("changed")
    remote.put({"stages/a/a.txt": here / "a.txt"})
    assert {name for name, tag in remote.files().items() if before[name] != tag} == {"stages/a/a.txt"}
    remote.remove(["stages/a/deep", "stages/a/a.txt", "not/there"])
    assert set(remote.files()) == {"stages/a/stage.json"}


def test_a_name_is_no_pattern_where_it_is_removed(url, tmp_path):
    (tmp_path / "a").touch()
    patterns, neighbours = ([Remote(f"{url}{end}") for end in ends] for ends in (("[2]", "*"), ("2", "7")))
    for remote in (*patterns, *neighbours):
        remote.put({"a": tmp_path / "a", "deep/[b]": tmp_path / "a", "deep/b": tmp_path / "a"})
    for remote in patterns:
        remote.remove(["a", "deep/[b]"])
    assert [set(remote.files()) for remote in patterns] == [{"deep/b"}] * 2
    assert [len(remote.files()) for remote in neighbours] == [3, 3]
    patterns[0].remove(["deep"])
    assert patterns[0].files() == {}


def test_no_name_leads_out_of_the_folder(tmp_path):
    listed = {f"/{tmp_path.name}/{name}": {"size": 1} for name in ("a", "b/../../c", "..", "/c", "a//b", "./d")}
    remote = store_of(Remote(f"memory://{tmp_path.name}"), find=lambda *_given, **_named: listed)
    assert set(remote.files()) == {"a"}


def test_a_bucket_that_is_not_there_is_named(monkeypatch, tmp_path):
    with served(monkeypatch) as bucket:
        (tmp_path / "a").touch()
        said = r"s3://survey-.*/run/a does not exist \(.*bucket.*\); make the bucket or folder, or correct the URL"
        with pytest.raises(SurveyError, match=said):
            Remote(f"{bucket}-other/run").put({"a": tmp_path / "a"})


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError("Access Denied"), r"refuses access \(Access Denied\); ask for the right to list, read and"),
        (type("NoCredentialsError", (Exception,), {})("none found"), "asks for keys, .* AWS_ACCESS_KEY_ID"),
        (OSError("no route"), r"was not reached \(OSError: no route\); check the URL, the network"),
    ],
)
def test_what_a_store_refuses_is_said_in_a_sentence(tmp_path, error, said):
    refused = dict.fromkeys(("find", "cat_file", "put_file"), raising(error))
    remote = store_of(Remote(f"memory://{tmp_path.name}"), **refused)
    (tmp_path / "a").touch()
    for ask in (remote.files, lambda: remote.read("a"), lambda: remote.put({"a": tmp_path / "a"})):
        with pytest.raises(SurveyError, match=said):
            ask()


def test_a_password_in_a_url_is_refused_and_not_repeated():
    with pytest.raises(SurveyError, match=r"sftp://me:\.\.\.@host/run has a password, expected none.*FSSPEC_SFTP_PASS"):
        Remote("sftp://me:se@cret@host/run")


def test_a_store_of_one_connection_moves_one_file_at_a_time(tmp_path):
    from fsspec.implementations.ftp import FTPFileSystem

    assert not FTPFileSystem.async_impl
    assert Remote(f"memory://{tmp_path.name}")._threads == 1
    assert Remote(tmp_path.as_uri())._threads > 1


@pytest.mark.parametrize("name", ["get_file", "put_file"])
def test_a_full_disk_is_named_as_such(tmp_path, name):
    path, full = tmp_path / "a", raising(OSError(errno.ENOSPC, "No space left on device"))
    path.touch()
    remote = store_of(Remote(f"memory://{tmp_path.name}"), **{name: full})
    move = remote.fetch if name == "get_file" else remote.put
    with pytest.raises(UnwritableFile, match=r"cannot write .*/a: no space is left on the disk; free some or"):
        move({"a": path})


def test_a_file_url_is_read_as_it_is_written(tmp_path):
    folder = tmp_path / "with space"
    folder.mkdir()
    (folder / "a").touch()
    assert set(Remote(folder.as_uri()).files()) == set(Remote(f"file://{folder}").files()) == {"a"}


def test_a_url_of_an_unknown_kind_is_named():
    with pytest.raises(SurveyError, match=r"nope://x is of an unknown kind .*name e\.g\. s3://"):
        Remote("nope://x")


def test_urls_are_told_from_paths_and_have_a_folder_of_their_own(tmp_path):
    assert [is_url(text) for text in ("s3://b/c", "sftp://host/x", "images", "C:\\x", "s3:/b", "://", None)] == [
        True, True, False, False, False, False, False,
    ]  # fmt: skip
    names = {local_name(url, "run") for url in ("s3://b/c", "s3://b/c/", "s3://b/d")}
    assert len(names) == 2
    assert all(name.startswith(".run-") for name in names)
    assert local_run(tmp_path, None) == tmp_path / "bathynerf"
    assert local_run(tmp_path, "other") == local_run(tmp_path, tmp_path.__class__("other"))
    assert local_run(tmp_path, "s3://b/c").parent == tmp_path
