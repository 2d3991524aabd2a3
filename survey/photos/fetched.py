"""Photographs at a URL: fetched into a hidden folder of the survey, each once, and again where it has changed."""

from __future__ import annotations

from pathlib import Path

from geo.files import disk_refusals
from survey.errors import ImageError, NotReached
from survey.files.json_values import read_json_object, write_json
from survey.files.remote import Remote
from survey.photos.exif import SUFFIXES
from survey.photos.images import is_hidden
from survey.progress import current

# Tags of the photographs that were fetched, by name.
_RECORD = ".fetched.json"
# Fetched side by side; what is finished when a fetch is interrupted is a multiple of them.
_TOGETHER = 16


def fetch_images(url: str, folder: Path) -> None:
    """Let a folder hold the photographs, and their masks, that lie below a URL.

    Where this is not reached and all were fetched before, these are used, with a warning.

    Raises
    ------
    ImageError
        If there are none.
    SurveyError
        If the URL is not reached; see `survey.files.remote`.
    """
    remote, before = Remote(url), fetched_tags(folder)
    try:
        there = remote.files()
    except NotReached as error:
        if not before or not all(tag and (folder / name).is_file() for name, tag in before.items()):
            raise
        current().warn(f"photographs are those that were fetched before, as {error}")
        return
    wanted = [name for name in there if Path(name).suffix.lower() in SUFFIXES and not is_hidden(Path(name))]
    if not wanted:
        raise ImageError(
            f"no images at {url}; expected files ending in {', '.join(SUFFIXES)}: put them there, or correct "
            "[images] dir in survey.toml"
        )
    with disk_refusals(folder):
        folder.mkdir(exist_ok=True)
    with disk_refusals(folder):
        for name in before.keys() - set(wanted):
            (folder / name).unlink(missing_ok=True)
    missing = [name for name in wanted if before.get(name) != there[name] or not (folder / name).is_file()]
    # What may be here when the fetch is interrupted has no tag: it is fetched again, or removed if it is gone by then.
    kept = {name: there[name] for name in wanted} | dict.fromkeys(missing, "")
    if kept != before:
        write_json(folder / _RECORD, kept)
    if missing:
        current().note(f"{len(missing)} of {len(wanted)} photographs are fetched from {url}")
        try:
            for first in range(0, len(missing), _TOGETHER):
                together = missing[first : first + _TOGETHER]
                remote.fetch({name: folder / name for name in together})
                kept |= {name: there[name] for name in together}
        finally:
            write_json(folder / _RECORD, kept)


def fetched_tags(folder: Path) -> dict[str, str]:
    """What `Remote.files` had for the photographs that `fetch_images` brought into a folder, by name."""
    return read_json_object(folder / _RECORD)
