"""Photographs at a URL: the survey is read as with them beside it, and each is fetched once."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import pytest
from s3_server import served
from small_survey import TOML, small_survey

from survey.errors import ConfigError, ImageError, SurveyError
from survey.files.remote import Remote, local_name
from survey.folder.survey import load_survey
from survey.photos import images
from survey.photos.images import fetch_images
from survey.settings.config import parse_config

pytest.importorskip("fsspec", reason="fsspec, of the extra `remote`, is not installed")


@pytest.fixture
def survey(tmp_path):
    """A survey of four photographs, which lie at a URL."""
    folder, there = small_survey(tmp_path / "survey"), tmp_path / "there"
    before = load_survey(folder)
    shutil.move(folder / "images", there)
    url = there.as_uri()
    (folder / "survey.toml").write_text(f'{TOML}[images]\ndir = "{url}"\n')
    return folder, there, url, before


def test_a_survey_of_photographs_at_a_url_is_that_of_photographs_beside_it(survey):
    folder, _, url, before = survey
    found, place = load_survey(folder), folder / local_name(url, "photographs")
    assert [view.name for view in found.views] == [view.name for view in before.views]
    assert {view.path.parent for view in found.views} == {place}
    assert found.frame.origin == before.frame.origin
    assert replace(found.config, images=before.config.images) == before.config


def test_only_what_is_new_or_changed_is_fetched_and_what_is_gone_removed(survey):
    folder, there, url, _ = survey
    place, before = folder / local_name(url, "photographs"), {}

    def fetched() -> list[str]:
        """Names of the files that are others than before."""
        fetch_images(url, place)
        stats = {path.name: path.stat() for path in place.glob("*.jpg")}
        # The number alone may be given again.
        now = {name: (stat.st_ino, stat.st_mtime_ns) for name, stat in stats.items()}
        names = sorted(name for name, number in now.items() if before.get(name) != number)
        before.update(now)
        return names

    (there / "notes.txt").touch()
    (there / ".hidden").mkdir()
    shutil.copy(there / "0000.jpg", there / ".hidden" / "0000.jpg")
    assert fetched() == ["0000.jpg", "0001.jpg", "0002.jpg", "0003.jpg"]
    assert fetched() == []
    (there / "0001.jpg").write_bytes((there / "0002.jpg").read_bytes() + b" ")
    (there / "0003.jpg").unlink()
    (place / "0000.jpg").unlink()
    assert fetched() == ["0000.jpg", "0001.jpg"]
    assert sorted(path.name for path in place.glob("*.jpg")) == ["0000.jpg", "0001.jpg", "0002.jpg"]
    assert (place / "0001.jpg").read_bytes() == (there / "0001.jpg").read_bytes()


@pytest.mark.parametrize("is_there", [False, True])
def test_what_is_gone_is_removed_also_after_an_interrupted_fetch(survey, monkeypatch, is_there):
    folder, there, url, _ = survey
    place = folder / local_name(url, "photographs")
    fetch_images(url, place)
    shutil.copy(there / "0000.jpg", there / "0004.jpg")
    (there / "0003.jpg").unlink()

    def lost(_remote, names):
        # One of those that are fetched side by side has come.
        if is_there:
            shutil.copy(there / "0004.jpg", names["0004.jpg"])
        raise SurveyError("was not reached")

    with monkeypatch.context() as patch:
        patch.setattr(Remote, "fetch", lost)
        with pytest.raises(SurveyError, match="not reached"):
            fetch_images(url, place)
    (there / "0004.jpg").unlink()
    fetch_images(url, place)
    assert sorted(path.name for path in place.glob("*.jpg")) == ["0000.jpg", "0001.jpg", "0002.jpg"]


def test_without_a_network_those_that_were_fetched_are_used(survey, monkeypatch):
    folder, _, url, _ = survey
    place = folder / local_name(url, "photographs")
    fetch_images(url, place)
    said = []
    monkeypatch.setattr(images, "current", lambda: SimpleNamespace(warn=said.append))
    unheard = "ftp://127.0.0.1:1/photographs"  # of a store that connects before it is asked for anything
    fetch_images(unheard, place)
    assert said[0].startswith("photographs are those that were fetched before, as ftp://127.0.0.1:1/photographs")
    (place / "0000.jpg").unlink()
    with pytest.raises(SurveyError, match="was not reached"):
        fetch_images(unheard, place)


def test_photographs_come_from_s3(survey, monkeypatch):
    folder, there, _, before = survey
    with served(monkeypatch) as bucket:
        Remote(bucket).put_folder(there, "flight")
        (folder / "survey.toml").write_text(f'{TOML}[images]\ndir = "{bucket}/flight"\n')
        found = load_survey(folder)
    assert [view.path.read_bytes() for view in found.views] == [
        (there / view.name).read_bytes() for view in before.views
    ]


def test_a_url_without_images_and_masks_at_a_url_are_named(tmp_path):
    with pytest.raises(ImageError, match=r"no images at .*, expected \.jpg.*put them there"):
        fetch_images(tmp_path.as_uri(), tmp_path / "here")
    with pytest.raises(ConfigError, match=r'masks is "s3://b/m", expected a folder; put masks beside the images'):
        parse_config('[images]\nmasks = "s3://b/m"\n')
