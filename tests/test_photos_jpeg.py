"""JPEGs that decode without an error and are not whole: every way to lose a part is refused, every whole one passes."""

from __future__ import annotations

import io
from functools import cache

import numpy as np
import pytest
from PIL import Image

from survey.errors import ImageError
from survey.photos.images import require_complete
from survey.photos.jpeg import jpeg_fault

SIZE = (400, 304)
FORMS = {
    "420": {"quality": 75, "subsampling": 2},
    "444": {"quality": 98, "subsampling": 0},
    "rough": {"quality": 20, "subsampling": 2},
    "optimised": {"quality": 75, "optimize": True},
    "restarts": {"quality": 90, "restart_marker_blocks": 7},
    "restart rows": {"quality": 90, "restart_marker_rows": 1, "optimize": True},
}
PROGRESSIVE = {"progressive": {"quality": 75, "progressive": True}}
EOI = b"\xff\xd9"


@cache
def ground(seed: int, *, rough: float = 30.0) -> np.ndarray:
    """Smooth and rough places, as photographs have them; not to be written to."""
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 255, (10, 13, 3), dtype=np.uint8)).resize(SIZE, Image.Resampling.BICUBIC)
    noise = rng.normal(0.0, 1.0, (SIZE[1], SIZE[0], 1)) * np.linspace(0.0, rough, SIZE[0])[None, :, None]
    pixels = np.clip(np.asarray(coarse) + noise, 0, 255).astype(np.uint8)
    pixels.flags.writeable = False
    return pixels


@cache
def gravel(seed: int) -> np.ndarray:
    """Stones of some pixels everywhere, 800 x 608; not to be written to."""
    pixels = np.random.default_rng(seed).integers(60, 190, (152, 200, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(pixels).resize((800, 608), Image.Resampling.BICUBIC))


def in_black(pixels: np.ndarray) -> np.ndarray:
    """With a black border, as undistorted photographs have it, and black below."""
    pixels = pixels.copy()
    pixels[:, :80] = pixels[:, -80:] = pixels[:40] = pixels[180:] = 0
    return pixels


CONTENTS = {
    "ground": ground(1),
    "grey": ground(1)[:, :, 0],
    "black below": in_black(ground(1)),
    "black": np.zeros((SIZE[1], SIZE[0], 3), np.uint8),
    "white": np.full((SIZE[1], SIZE[0], 3), 255, np.uint8),
    "gradient": np.repeat(np.linspace(0, 255, SIZE[0]).astype(np.uint8)[None], SIZE[1], axis=0),
    "noise": np.random.default_rng(2).integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8),
    "odd size": ground(3)[:131, :77],
    "tiny": ground(3)[:5, :3],
}


def jpeg(pixels: np.ndarray, **form) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "JPEG", **form)
    return stream.getvalue()


def scan_of(data: bytes) -> int:
    """Where the compressed pixels of the only scan begin."""
    at = data.index(b"\xff\xda")
    return at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")


def filled(data: bytes, at: int, end: int) -> bytes:
    return data[:at] + bytes(end - at) + data[end:]


# Each gets the file, a photograph of another place in the same form, and a position within the compressed pixels.
DAMAGES = {
    "cut": lambda data, other, at: data[:at],
    "cut, with an end mark": lambda data, other, at: data[:at] + EOI,
    "zeros to the end": lambda data, other, at: filled(data, at, len(data)),
    "zeros to the end mark": lambda data, other, at: filled(data, at, len(data) - 2),
    "a lost sector": lambda data, other, at: filled(data, at, min(at + 512, len(data) - 2)),
    "a sector of 0xff": lambda data, other, at: data[:at] + b"\xff" * 512 + data[at + 512 :],
    "text": lambda data, other, at: data[:at] + (b"GET / HTTP/1.1 " * 200)[:2500] + data[at + 2500 :],
    "the end of another": lambda data, other, at: data[:at] + other[len(other) * at // len(data) :],
    "a part left out": lambda data, other, at: data[:at] + data[at + (len(data) - at) // 3 :],
    "a part twice": lambda data, other, at: data[:at] + data[at - 400 :],
}


@pytest.mark.parametrize("form", FORMS | PROGRESSIVE)
@pytest.mark.parametrize("content", CONTENTS)
def test_every_whole_jpeg_passes(content, form):
    data = jpeg(CONTENTS[content], **(FORMS | PROGRESSIVE)[form])
    assert jpeg_fault(data) is None
    # Previews of a camera before and behind it, and fill bytes before the end mark.
    preview = jpeg(ground(4)[:64, :64])
    application = b"\xff\xe1" + (len(preview) + 2).to_bytes(2, "big") + preview
    assert jpeg_fault(data[:2] + application + data[2:] + preview + bytes(3000)) is None
    assert jpeg_fault(data[:-2] + b"\xff\xff\xff" + EOI) is None
    assert jpeg_fault(data[:-2] + bytes(8) + EOI) is None
    assert jpeg_fault(data[:-2]) is None


@pytest.mark.parametrize("share", [0.03, 0.4, 0.77])
@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("form", FORMS | PROGRESSIVE)
def test_every_damaged_jpeg_is_refused(form, damage, share):
    data, other = (jpeg(ground(n, rough=rough), **(FORMS | PROGRESSIVE)[form]) for n, rough in ((5, 30.0), (6, 90.0)))
    at = int(scan_of(data) + 400 + share * (len(data) - scan_of(data) - 3000))
    assert jpeg_fault(DAMAGES[damage](data, other, at)) is not None


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_a_progressive_jpeg_without_all_of_its_scans_is_refused(share):
    data = jpeg(ground(5), **PROGRESSIVE["progressive"])
    assert jpeg_fault(data[: int(share * len(data))] + EOI) == "some of its scans are missing"


# At a quality of 20 all blocks stand off from each other.
@pytest.mark.parametrize("form", [form for form in FORMS if form != "rough"])
@pytest.mark.parametrize(("row", "column"), [(32, 96), (320, 416), (512, 704)])
@pytest.mark.parametrize("brightness", [0, 8, 300, -300])
def test_what_is_joined_with_just_as_many_blocks_leaves_a_seam(form, row, column, brightness):
    """What stands behind the seam has another brightness, up to all white or black."""
    found, other = gravel(5).copy(), np.clip(gravel(6) + float(brightness), 0, 255).astype(np.uint8)
    unit = 8 if form == "444" else 16
    found[row + unit :] = other[row + unit :]
    found[row : row + unit, column:] = other[row : row + unit, column:]
    assert "another scene" in jpeg_fault(jpeg(found, **FORMS[form]))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("content", ["black", "white", "another"])
@pytest.mark.parametrize("rows", [np.s_[:96], np.s_[-64:], np.s_[304:]], ids=["above", "below", "half"])
def test_bars_and_pictures_over_each_other_are_no_seams(form, rows, content):
    pixels = gravel(1).copy()
    pixels[rows] = {"black": 0, "white": 255, "another": gravel(2)[rows]}[content]
    assert jpeg_fault(jpeg(pixels, **FORMS[form])) is None


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("period", [8, 16, 30, 100])
@pytest.mark.parametrize("kind", ["stripes", "squares", "one edge beside blocks"])
def test_straight_edges_of_a_scene_are_no_seams(form, period, kind):
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    if kind == "one edge beside blocks":
        bright = y > 2 * period + 3
    else:
        bright = (y // period + (x // period if kind == "squares" else 0)) % 2 == 1
    pixels = np.clip(ground(7) * 0.5 + 100.0 * bright[..., None], 0, 255).astype(np.uint8)
    assert jpeg_fault(jpeg(pixels, **FORMS[form])) is None


@pytest.mark.parametrize("progressive", [False, True])
def test_the_header_of_a_scan_with_too_many_components_is_left_to_the_decoder(progressive):
    stream = io.BytesIO()
    Image.fromarray(ground(1)).save(stream, "JPEG", progressive=progressive)
    data = bytearray(stream.getvalue())
    # Marker, length, then the number of components.
    data[data.rindex(b"\xff\xda") + 4] = 255
    assert jpeg_fault(bytes(data)) is None


def test_the_photograph_is_named_with_the_reason(tmp_path):
    data = jpeg(ground(5))
    path = tmp_path / "a.jpg"
    path.write_bytes(filled(data, len(data) // 2, len(data)))
    with pytest.raises(
        ImageError,
        match=r"a\.jpg is damaged or cut off \(compressed pixels .* by zeros\); copy it",
    ):
        require_complete(path)


@pytest.mark.parametrize(
    "data", [b"", b"\xff\xd8", b"\xff\xd8\xff\xda", b"\xff\xd8\xff\xda\0\2", b"\xff\xd8" + b"\xff" * 9]
)
def test_what_is_no_jpeg_is_left_to_its_decoder(data):
    assert jpeg_fault(data) is None
