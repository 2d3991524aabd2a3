"""Names of photographs: the longest common tail of the paths decides, and nothing is guessed."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from survey.errors import ImageError
from survey.photos.poses import ImageNames

FOLDERS = st.lists(st.sampled_from(["100MEDIA", "101MEDIA", "flight1", "flight2"]), max_size=3)
FILES = st.sampled_from(["DJI_0001.JPG", "DJI_0002.JPG", "shore 1.jpg"])
PATHS = st.builds(lambda folders, file: "/".join([*folders, file]), FOLDERS, FILES)


def tails(name: str) -> list[str]:
    parts = name.split("/")
    return ["/".join(parts[i:]) for i in range(len(parts))]


@settings(max_examples=300)
@given(st.sets(PATHS, min_size=1, max_size=8), PATHS)
def test_found_photographs_agree_and_doubtful_names_are_refused(images: set[str], called: str) -> None:
    agreeing = {image for image in images if called in tails(image) or image in tails(called)}
    longest = max((min(image.count("/"), called.count("/")) for image in agreeing), default=0)
    best = {image for image in agreeing if min(image.count("/"), called.count("/")) == longest}
    best = best & {called} or best
    names = ImageNames(images)
    if len(best) > 1:
        with pytest.raises(ImageError, match=r"line 3: .* fits .* and .*folder"):
            names.find(called, "line 3")
    else:
        assert names.find(called, "line 3") == (best.pop() if best else None)


@given(st.sets(PATHS, min_size=1, max_size=8), st.sampled_from(["", "images/", "C:\\project\\images\\"]), st.data())
def test_whole_paths_are_found_below_any_folder_in_any_case(images: set[str], above: str, data: st.DataObject) -> None:
    image = data.draw(st.sampled_from(sorted(images)))
    called = (above + image.replace("/", "\\")).upper()
    assert ImageNames(images).find(called, "line 3") == image


def test_two_photographs_of_a_file_are_not_one_of_the_survey() -> None:
    names = ImageNames(["DJI_0001.JPG"])
    assert names.find("flight1/DJI_0001.JPG", "line 1") == "DJI_0001.JPG"
    assert names.find("dji_0001", "line 2") == "DJI_0001.JPG"
    with pytest.raises(ImageError, match=r"line 3: flight2/DJI_0001.JPG and flight1/DJI_0001.JPG are two"):
        names.find("flight2/DJI_0001.JPG", "line 3")


def test_folders_that_contradict_each_other_do_not_match() -> None:
    assert ImageNames(["flight2/0001.jpg"]).find("flight1/0001.jpg", "line 1") is None
