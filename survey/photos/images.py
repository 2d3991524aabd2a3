"""Photographs: found, fetched from a URL, checked, decoded and made smaller."""

import os
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from hashlib import blake2b
from pathlib import Path
from threading import Lock

import cv2
import numpy as np

from geo.files import reporting_disk_errors
from survey import machine
from survey.errors import ImageError, NotReached
from survey.files.json_values import read_json_object, write_json
from survey.files.remote import Remote
from survey.photos.cameras import View
from survey.photos.exif import SUFFIXES
from survey.photos.pixels import read_grey, read_opaque, read_rgb, require_complete, require_pixels
from survey.photos.poses import MASK_ENDING
from survey.progress import current
from survey.stage_key import content_hash
from survey.words import RUN_FOLDER

# White of 16 bits in white of 8 bits.
_STEPS = 257.0
# Weights of red, green and blue in the grey that is matched: luma, as JPEG has it.
LUMA = (0.299, 0.587, 0.114)
# Visible folders without photographs that Synology, QNAP, macOS archives and Windows create.
_NOT_OF_CAMERAS = (
    *("@eadir", "@__thumb", "__macosx", "thumbnails", "thumbs", "system volume information", "lost+found"),
    *("$recycle.bin", "#recycle", "@recycle", "#snapshot", "@recently-snapshot"),
)
# Single bands of DJI's and Parrot's multispectral cameras: near infrared, red edge, red, green, blue. Their photographs
# end in _D and _RGB; views of oblique rigs in _D, _F, _L, _R, _B too.
_BAND = re.compile(r"(.+?)(?:(_MS_(?:NIR|RE|R|G|B))|_(?:NIR|REG|RED|GRE))\.TIFF?", re.IGNORECASE)
# Each has the bytes of its file in memory.
_MOST_AT_ONCE = 8
_LOSSY = (".jpg", ".jpeg")
# At either end of a file.
_COMPARED_BYTES = 65_536
# Cache size as a share of the free memory, and at most; decoding again costs 15 ms per megapixel.
_SHARE_OF_FREE, _MOST_BYTES = 0.25, 100_000_000


def list_images(folder: Path, *, deep: bool = True) -> dict[str, Path]:
    """Images in a folder and, if `deep`, below it, by name: the path in the folder with forward slashes.

    Hidden files and folders, and those in which storage devices and archives keep thumbnails, are left out.
    A file named like another one with _mask behind, as OpenDroneMap has them, is its mask, and no image; nor are the
    single bands beside the photographs of a multispectral camera: `bands_beside`.
    """
    if not folder.is_dir():
        raise ImageError(
            f"the image folder {folder} does not exist{photographs_elsewhere(folder.parent)}; correct [images] dir "
            "in survey.toml, or make the folder"
        )
    below = folder.rglob("*") if deep else folder.iterdir()
    files = sorted(
        p for p in below if p.suffix.lower() in SUFFIXES and not is_hidden(p.relative_to(folder)) and p.is_file()
    )
    names = {path.with_suffix("") for path in files} | set(files)
    named = (path for path in files if path.stem.lower().endswith(MASK_ENDING))
    masks = {path for path in named if path.with_name(path.stem[: -len(MASK_ENDING)]) in names}
    files = [path for path in files if path not in masks and not _is_band(path, names)]
    if not files:
        raise ImageError(
            f"no images in {folder}{photographs_elsewhere(folder.parent, folder)}; expected files ending in "
            f"{', '.join(SUFFIXES)}"
        )
    return {path.relative_to(folder).as_posix(): path for path in files}


def bands_beside(images: Mapping[str, Path]) -> list[str]:
    """Names of the TIFFs of single bands, as DJI_1_MS_NIR.TIF with DJI_1_D.JPG, in the folders of images."""
    names = {path.with_suffix("") for path in images.values()}
    places = sorted({path.parent for path in images.values()})
    return [path.name for place in places for path in sorted(place.iterdir()) if _is_band(path, names)]


def _is_band(path: Path, names: Collection[Path]) -> bool:
    """Whether a file is a band of one of the photographs, of whose names without their ends some are given."""
    found = _BAND.fullmatch(path.name)
    return found is not None and path.with_name(found[1] + ("_D" if found[2] else "_RGB")) in names


def photographs_below(folder: Path, but: Path | None = None) -> dict[str, int]:
    """Folders with photographs, by their path in a folder, and how many; outside of `but`, runs and masks.

    Of several folders in one, as of DCIM, it is that one.
    """
    by_top: dict[str, list[Path]] = defaultdict(list)
    for path in sorted(folder.rglob("*")):
        own = path.relative_to(folder)
        is_left_out = is_hidden(own) or own.parts[0] in (RUN_FOLDER, "masks") or (but and path.is_relative_to(but))
        if len(own.parts) > 1 and path.suffix.lower() in SUFFIXES and not is_left_out:
            by_top[own.parts[0]].append(own.parent)
    return {Path(os.path.commonpath(places)).as_posix(): len(places) for places in by_top.values()}


def photographs_elsewhere(folder: Path, but: Path | None = None) -> str:
    """Where else below a folder photographs lie, or files of other kinds in `but`, as a part of a sentence."""
    if places := photographs_below(folder, but):
        place = max(places, key=lambda each: places[each])
        return f', but {places[place]} photographs lie in {folder / place}: write [images] dir = "{place}" for them'
    kinds = Counter(path.suffix for path in (but.rglob("*") if but else ()) if path.suffix and path.is_file())
    return f", but {kinds.most_common(1)[0][1]} files ending in {kinds.most_common(1)[0][0]}" if kinds else ""


def is_hidden(path: Path) -> bool:
    """Whether a path in a folder, relative to it, is hidden, or of a thumbnail."""
    return any(part[0] == "." or part.casefold() in _NOT_OF_CAMERAS for part in path.parts)


def same_files(images: Mapping[str, Path]) -> list[tuple[str, ...]]:
    """Names of images whose files are copies of each other; read whole where size, beginning and end are the same."""

    def ends(path: Path) -> bytes:
        with path.open("rb") as file:
            first = file.read(_COMPARED_BYTES)
            file.seek(-min(_COMPARED_BYTES, path.stat().st_size), os.SEEK_END)
            return blake2b(first + file.read()).digest()

    groups: list[tuple[str, ...]] = [tuple(images)]
    for key in (lambda path: path.stat().st_size, ends, content_hash):
        alike: dict[object, list[str]] = defaultdict(list)
        for number, names in enumerate(groups):
            for name in names:
                alike[number, key(images[name])].append(name)
        groups = [tuple(names) for names in alike.values() if len(names) > 1]
    return groups


def require_all_complete(paths: Iterable[Path]) -> None:
    """Raise ImageError for the first image that `require_complete` rejects; images are tested on all cores."""
    with ThreadPoolExecutor(min(machine.num_cores(), _MOST_AT_ONCE)) as pool:
        for _ in pool.map(require_complete, paths):
            pass


def load_image(view: View, *, scale: float = 1.0) -> np.ndarray:
    """The photograph as `view.camera` took it, in the 8 bits that colours of points have: (height, width, 3), RGB.

    At a scale below 1 pixels are averaged over their area; the result fits ``view.camera.scaled(scale)``. EXIF
    orientation is not applied: poses and sizes are those of the stored pixels.
    """
    return eight_bits(load_pixels(view, scale=scale))


def load_pixels(view: View, *, scale: float = 1.0) -> np.ndarray:
    """The photograph as `load_image` gives it, with the depth of the file: uint8 or uint16."""
    return _of_camera(view, read_rgb(view.path), scale)


def eight_bits(pixels: np.ndarray) -> np.ndarray:
    """Pixels of 8 or 16 bits as uint8, rounded."""
    return pixels if pixels.dtype == np.uint8 else np.rint(pixels / _STEPS).astype(np.uint8)


def grey_levels(pixels: np.ndarray) -> np.ndarray:
    """Brightness (height, width) float32 of pixels (height, width, 3), 0 to 255; of 16 bits with all their steps."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return grey if pixels.dtype == np.uint8 else grey / np.float32(_STEPS)


def load_mask(view: View, *, scale: float = 1.0) -> np.ndarray | None:
    """Mask of the usable pixels of a photograph, (height, width) bool; None where all are.

    Black of the mask of the view is left out, and so is what is transparent in the photograph itself.
    """
    used = read_opaque(view.path)
    if view.mask_path is not None:
        mask = _of_camera(view, read_mask(view.mask_path), 1.0, view.mask_path)
        used = mask if used is None else used & mask
    if used is None or used.all():
        return None
    # A pixel of the smaller image is used where all of its area is; the average is rounded in float32.
    return _of_camera(view, used.astype(np.float32), scale) > 1.0 - 1e-4


def read_mask(path: Path) -> np.ndarray:
    """Usable pixels by a mask, (height, width) bool: all that are not black.

    JPEG has grey levels about the edges of black and white, so that the darker half counts as black there.
    """
    return read_grey(path) > (127 if path.suffix.lower() in _LOSSY else 0)


def _of_camera(view: View, pixels: np.ndarray, scale: float, path: Path | None = None) -> np.ndarray:
    """Pixels of a file, of the size of the camera, at a scale."""
    expected, remedy = (view.camera.width, view.camera.height), "use the images that the poses were made from"
    require_pixels(path or view.path, pixels.shape[1::-1], expected, "its camera", remedy)
    if scale == 1.0:
        return pixels
    camera = view.camera.scaled(scale)
    return cv2.resize(pixels, (camera.width, camera.height), interpolation=cv2.INTER_AREA)


class ImageStore:
    """`survey.photos.images.load_image` with a cache of bounded memory.

    Stages read the photographs in the same order, so that the first images that fit are kept: evicting the least
    recently used one would evict each image just before it is used again. By default they take a quarter of the free
    memory, at most 100 MB.
    """

    def __init__(self, budget_bytes: int | None = None):
        if budget_bytes is None:
            budget_bytes = min(int(_SHARE_OF_FREE * machine.free_memory_bytes()), _MOST_BYTES)
        self._budget, self._left, self._lock = budget_bytes, budget_bytes, Lock()
        self._images: dict[tuple, np.ndarray] = {}

    def load(self, view: View, *, scale: float = 1.0) -> np.ndarray:
        """The photograph (height, width, 3) uint8, RGB, not to be written to; see `load_image`."""
        image = eight_bits(self._pixels(view, scale))
        image.flags.writeable = False
        return image

    def grey(self, view: View, *, scale: float = 1.0) -> np.ndarray:
        """The brightness (height, width) float32 of the photograph, 0 to 255, with the depth of its file."""
        return grey_levels(self._pixels(view, scale))

    def clear(self) -> None:
        """Forget the kept images: others come next."""
        with self._lock:
            self._images.clear()
            self._left = self._budget

    def _pixels(self, view: View, scale: float) -> np.ndarray:
        key = (view.path, view.lens, scale)
        if (kept := self._images.get(key)) is not None:
            return kept
        image = load_pixels(view, scale=scale)
        with self._lock:
            if image.nbytes <= self._left and key not in self._images:
                self._left -= image.nbytes
                self._images[key] = image
        return image


# Tags of the photographs that were fetched, by name.
_RECORD = ".fetched.json"
# Number of photographs fetched at a time; an interrupted fetch has finished a multiple of it.
_TOGETHER = 16


def fetch_images(url: str, folder: Path) -> None:
    """Fetch the photographs and masks below a URL into a folder.

    If the URL cannot be reached and all were fetched before, these are used, with a warning.
    """
    before = fetched_tags(folder)
    try:
        tags = (remote := Remote(url)).files()  # some stores connect when they are made
    except NotReached as error:
        if not before or not all(tag and (folder / name).is_file() for name, tag in before.items()):
            raise
        current().warn(f"photographs are those that were fetched before, as {error}")
        return
    photographs = [name for name in tags if Path(name).suffix.lower() in SUFFIXES and not is_hidden(Path(name))]
    if not photographs:
        raise ImageError(f"no images at {url}, expected {', '.join(SUFFIXES)}; put them there, or correct [images] dir")
    with reporting_disk_errors(folder):
        folder.mkdir(exist_ok=True)
    with reporting_disk_errors(folder):
        for name in before.keys() - set(photographs):
            (folder / name).unlink(missing_ok=True)
    missing = [name for name in photographs if before.get(name) != tags[name] or not (folder / name).is_file()]
    # What may be here when the fetch is interrupted has no tag: it is fetched again, or removed if it is gone by then.
    kept = {name: tags[name] for name in photographs} | dict.fromkeys(missing, "")
    if kept != before:
        write_json(folder / _RECORD, kept)
    if missing:
        current().note(f"{len(missing)} of {len(photographs)} photographs are fetched from {url}")
        try:
            for first in range(0, len(missing), _TOGETHER):
                together = missing[first : first + _TOGETHER]
                remote.fetch({name: folder / name for name in together})
                kept |= {name: tags[name] for name in together}
        finally:
            write_json(folder / _RECORD, kept)


def fetched_tags(folder: Path) -> dict[str, str]:
    """What `Remote.files` had for the photographs that `fetch_images` brought into a folder, by name."""
    return read_json_object(folder / _RECORD)
