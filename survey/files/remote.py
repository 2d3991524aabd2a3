"""Folders at a URL, as s3://bucket/run, by fsspec: files are fetched and put whole.

Nothing here is reached unless a user names a URL.
"""

import errno
import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from geo.errors import GeoError
from geo.files import reporting_disk_errors, write_whole_at
from survey.errors import NotReached, SurveyError
from survey.words import RUN_FOLDER

_URL = re.compile(r"[a-z][a-z0-9+.-]+://.", re.IGNORECASE)
_PASSWORD = re.compile(r"(://[^/:@]*):[^/]*@")
# Stores that have folders, which are to be made; in the others a name with slashes is enough.
_WITH_FOLDERS = {"file", "local", "sftp", "ssh", "smb", "hdfs", "webdav", "webhdfs", "ftp"}
# What tells one content of a file from another, as stores have it; the first that there is.
_TAGS = ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "modified", "created")
_AT_ONCE = 8
# Of a disk, here or at file://; networks have other numbers.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def is_url(text: object) -> bool:
    """Whether a text is a URL, and no path."""
    return isinstance(text, str) and _URL.match(text) is not None


def local_name(url: str, kind: str) -> str:
    """Name of the hidden folder that holds what a URL does, e.g. .run-1f2e3d4c5b6a."""
    return f".{kind}-{hashlib.sha256(url.rstrip('/').encode()).hexdigest()[:12]}"


def local_run(survey: Path, run: str | Path | None) -> Path:
    """Folder of this machine that a run works in: for one at a URL a hidden folder of the survey."""
    if run is None:
        return survey / RUN_FOLDER
    return survey / local_name(run, "run") if isinstance(run, str) and is_url(run) else Path(run)


class Remote:
    """A folder at a URL; names are relative to it, with forward slashes.

    Keys and addresses of the store are those of its environment, as AWS_ACCESS_KEY_ID and AWS_ENDPOINT_URL; a
    password in the URL would come into messages, logs and jobs, and is refused.
    """

    def __init__(self, url: str):
        self.url = url.rstrip("/")
        if _PASSWORD.search(self.url):
            shown = _PASSWORD.sub(r"\1:...@", self.url)
            raise SurveyError(
                f"{shown} has a password, expected none, as it would come into logs; leave it out and give it by the "
                "environment, for sftp:// in FSSPEC_SFTP_PASSWORD"
            )
        try:
            import fsspec
        except ModuleNotFoundError as error:
            raise SurveyError(f"{url} needs fsspec, which is not installed: pip install 'bathynerf[remote]'") from error
        with _refusals(self.url):
            # As `Path.as_uri` writes them; fsspec takes a path as it is.
            is_path = self.url.lower().startswith(("file://", "local://"))
            self._store, self._root = fsspec.core.url_to_fs(unquote(self.url) if is_path else self.url)
        kinds = self._store.protocol
        self._has_folders = bool({kinds} & _WITH_FOLDERS if isinstance(kinds, str) else {*kinds} & _WITH_FOLDERS)
        # Others, as ftp, have one connection, whose answers would mix.
        self._threads = _AT_ONCE if is_path or self._store.async_impl else 1

    def files(self, name: str = "") -> dict[str, str]:
        """Files below a name, each with a tag that changes with its content; empty where there are none."""
        return {each: _tag(info) for each, info in self._listed(name).items()}

    def tag(self, name: str) -> str | None:
        """Tag of a file, as of `files`; None where it is not there."""
        with _refusals(self.url):
            self._store.invalidate_cache()
            try:
                return _tag(self._store.info(self._place(name)))
            except FileNotFoundError:
                return None

    def sizes(self, name: str) -> dict[str, int | None]:
        """Files below a name, with their sizes [bytes]; None where the store states none."""
        return {each: info.get("size") for each, info in self._listed(name).items()}

    def _listed(self, name: str) -> dict[str, Mapping[str, Any]]:
        place = self._place(name)
        with _refusals(self.url):
            # Another machine may have written.
            self._store.invalidate_cache()
            found: Mapping[str, Mapping[str, Any]] = self._store.find(place, detail=True)
        start = len(place.strip("/")) + 1
        names = {path.strip("/")[start:]: info for path, info in sorted(found.items())}
        # No name leads out of the folder that it is fetched into: `folder / "/etc/x"` is /etc/x.
        return {each: info for each, info in names.items() if not {"", ".", ".."} & {*each.split("/")}}

    def read(self, name: str) -> bytes | None:
        """Contents of a file; None where it is not there."""
        with _refusals(self.url):
            try:
                return self._store.cat_file(self._place(name))
            except (FileNotFoundError, NotADirectoryError):
                return None

    def fetch(self, names: Mapping[str, Path], *, last: str | None = None) -> None:
        """Fetch files, each whole or not at all, to paths; the ``last`` after all others."""
        self._at_once(self._fetch, names.items(), last)

    def put(self, paths: Mapping[str, Path], *, last: str | None = None) -> None:
        """Put files at paths, by the names that they get; the ``last`` after all others."""
        self._at_once(self._put, paths.items(), last)

    def fetch_folder(self, name: str, folder: Path, *, last: str | None = None) -> None:
        """Fetch all files below a name; ``last``, the mark that they are complete, after all others."""
        self.fetch({f"{name}/{each}": folder / each for each in self.files(name)}, last=f"{name}/{last}")

    def put_folder(self, folder: Path, name: str, *, last: str | None = None) -> None:
        """Put all files of a folder; ``last``, the mark that it is complete, after all others."""
        files = {f"{name}/{path.relative_to(folder).as_posix()}": path for path in files_below(folder)}
        self.put(files, last=f"{name}/{last}")

    def copy_folder(self, name: str, other: str) -> None:
        """Copy all files below a name to another one, at the URL itself."""
        self._at_once(self._copy, [(f"{name}/{each}", f"{other}/{each}") for each in self.files(name)])

    def remove(self, names: Iterable[str]) -> None:
        """Remove files, and folders with all in them, in this order; those that are not there, too."""
        for name in names:
            with _refusals(self.url):
                self._store.invalidate_cache()
                found = self._store.find(self._place(name), withdirs=self._has_folders, detail=True)
            is_folder = {path: info.get("type") == "directory" for path, info in found.items()}
            self._at_once(self._remove_file, ((path, None) for path in found if not is_folder[path]))
            with _refusals(self.url):
                # The deepest first.
                for path in sorted((path for path in found if is_folder[path]), reverse=True):
                    self._store.rmdir(path)

    def _place(self, name: str) -> str:
        return f"{self._root.rstrip('/')}/{name}" if name else self._root

    def _at_once(self, move: Any, files: Iterable[tuple[str, Any]], last: str | None = None) -> None:
        files = list(files)
        with ThreadPoolExecutor(self._threads) as pool:
            for is_last in (False, True):
                for _ in pool.map(move, [file for file in files if (file[0] == last) is is_last]):
                    pass

    def _fetch(self, file: tuple[str, Path]) -> None:
        name, path = file
        with reporting_disk_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        with write_whole_at(path) as part:
            # What refuses this is the disk, and not the store.
            part.touch()
            with _refusals(f"{self.url}/{name}"):
                self._store.get_file(self._place(name), str(part))

    def _remove_file(self, file: tuple[str, None]) -> None:
        # `rm` would take a name with [, * or ? as a pattern.
        with _refusals(self.url), suppress(FileNotFoundError):
            self._store.rm_file(file[0])

    def _copy(self, names: tuple[str, str]) -> None:
        name, other = names
        place = self._place(other)
        with self._refusals_of(name):
            self._make_folder(place)
            self._store.cp_file(self._place(name), place)

    @contextmanager
    def _refusals_of(self, name: str) -> Iterator[None]:
        """`_refusals` of a file that is written at the URL, which may be on a disk that is full."""
        with reporting_disk_errors(f"{self.url}/{name}"), _refusals(f"{self.url}/{name}"):
            yield

    def _make_folder(self, place: str) -> None:
        if self._has_folders:
            self._store.makedirs(place.rpartition("/")[0], exist_ok=True)

    def _put(self, file: tuple[str, Path]) -> None:
        name, path = file
        place = self._place(name)
        with self._refusals_of(name):
            self._make_folder(place)
            self._store.put_file(str(path), place)


def files_below(folder: Path) -> list[Path]:
    """Files in a folder and below it, hidden ones of the top left out."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.relative_to(folder).parts[0][0] != ".")


def _tag(info: Mapping[str, Any]) -> str:
    tag = next((info[name] for name in _TAGS if info.get(name) is not None), "")
    # Stores have it in one form in lists, and in another of one file.
    tag = tag.timestamp() if isinstance(tag, datetime) else str(tag).strip('"')
    return f"{info.get('size')} {tag}"


@contextmanager
def _refusals(url: str) -> Iterator[None]:
    """Turn what libraries of stores raise into a sentence; each has exceptions of its own. A full disk goes through."""
    try:
        yield
    except (SurveyError, GeoError):
        raise
    except ImportError as error:
        raise SurveyError(f"{url} needs a library ({error}); for s3:// pip install 'bathynerf[remote]'") from error
    except FileNotFoundError as error:
        raise SurveyError(f"{url} does not exist ({error}); make the bucket or folder, or correct the URL") from error
    except PermissionError as error:
        raise SurveyError(f"{url} refuses access ({error}); ask for the right to list, read and write it") from error
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _FULL:
            raise
        if "Credentials" in type(error).__name__:
            remedy = "set its keys, for s3:// AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY or a profile"
            raise SurveyError(f"{url} asks for keys, and there are none ({error}); {remedy}") from error
        if isinstance(error, ValueError) and "rotocol" in str(error):
            raise SurveyError(f"{url} is of an unknown kind ({error}); name e.g. s3://bucket/folder") from error
        raise NotReached(
            f"{url} was not reached ({type(error).__name__}: {error}); check the URL, the network and the settings of "
            "the store, for s3:// AWS_ENDPOINT_URL, and run the same command again"
        ) from error
