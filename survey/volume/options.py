"""Options of `bathynerf field`: of a training and its results, from the command line and from [field].

With monocular depth and normals of photographs, from the files of networks that predict them.
"""

import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fields.models import MODELS, Losses, Rule, maker
from fields.volume.photographs import PriorImages
from refract import PinholeCamera
from survey.errors import FILE_NAME, SurveyError
from survey.export.loaded import LoadedRun, survey_folder
from survey.files.toml_table import require_valid
from survey.progress import current
from survey.run.trained_field import VolumeRecipe
from survey.settings.config import SurveyConfig, settings_of
from survey.settings.tables import FieldConfig
from survey.stage_key import content_hash

MONOCULAR = (0.1, 0.05)  # Weights of depth and of normals (MonoSDF, Yu et al. 2022)


@dataclass(frozen=True)
class VolumeOptions(FieldConfig):
    """Options of the training of a radiance field on a run, and of its products, with their defaults."""

    model: str = "mdw"
    steps: int = 2000
    rays: int = 4096
    samples: int = 48
    cells: int = 256
    appearance: bool = False
    shell: bool = False
    from_scratch: bool = False
    # Where none of depth and normal has a weight, those of MonoSDF count with ``monocular``
    losses: Losses = field(default_factory=Losses)
    device: str = "auto"  # "auto", "cpu", "cuda" or "torch"

    def __post_init__(self):
        try:
            maker(self.model)
        except ValueError as error:
            raise SurveyError(str(error)) from error
        require_valid(self, FieldConfig, lambda each: each.name)
        if self.submodules is not None and not re.fullmatch("[1-9][0-9]{0,3}(x[1-9][0-9]{0,3})?", self.submodules):
            raise SurveyError(f"submodules is {self.submodules}, expected a number, or 3x2: along east and along north")
        for option, needed in self._without_effect():
            raise SurveyError(f"{option} has no effect without {needed}; give both or leave it out")
        if self.monocular is None and (self.losses.depth or self.losses.normal):
            raise SurveyError(
                "losses on monocular depth or normals have a weight, but there are none; name their folder with "
                "--monocular DIR"
            )

    def _without_effect(self) -> Iterator[tuple[str, str]]:
        """Options that were given and that nothing uses, with what they need."""
        of = self.losses
        if self.as_published:
            yield "as_published", "volume_options, which knows what else is given"
        if self.drop is not None and self.submodules is None:
            yield "--drop", "--submodules"
        if self.density is not None and self.rule is not Rule.density:
            yield "--density", "--extract density"
        if self.dry and self.cameras is None:
            yield "--dry", "--cameras"
        if of.transparency and not self.shell:
            # Light that passes the box is lost nowhere else: the last sample takes it.
            yield "[field.losses] transparency", "--shell"
        if of.patch_px is not None and not of.have_patches:
            yield "[field.losses] patch_px", "ncc, ssim or virtual_patches"

    def of_training(self, run: LoadedRun) -> dict[str, Any]:
        """All that the trained field depends on: the result of the run, the options, and the monocular priors."""
        made = ("rule", "density", "reference", "cameras", "dry", "survey", "device", "drop", "as_published")
        settings = {name: value for name, value in asdict(self).items() if name not in made}
        priors = None if self.monocular is None else priors_hash(Path(self.monocular))
        of_run = {"run": str(run.folder.path.absolute()), "result": run.stages}
        if (every := self.held_every) is not None:
            # Fields of before this key held out others of as many.
            settings["held_out"] = f"photographs 0, {every}, {2 * every}, ..."
        return of_run | settings | {"monocular": priors}

    @property
    def recipe(self) -> VolumeRecipe:
        """Options of the model and its paths."""
        return VolumeRecipe.of({each.name: getattr(self, each.name) for each in fields(self)})

    def of_losses(self) -> Losses:
        """The weights of the losses, with those of monocular priors where none is given."""
        if self.monocular is None or self.losses.depth or self.losses.normal:
            return self.losses
        depth, normal = MONOCULAR
        return replace(self.losses, depth=depth, normal=normal)


def field_config(run: str | Path, survey: str | None) -> FieldConfig:
    """[field] in the current survey.toml of a run: beside it, as where both were copied, or in its survey's folder."""
    with LoadedRun(run) as loaded:
        beside, owner = loaded.folder.path.absolute().parent, loaded.folder.owner()
        images, sizes = beside / loaded.config.images.local_dir, {} if owner is None else owner.photographs
        # With -o a run may lie in the folder of a survey of other photographs.
        is_own = all((images / n).is_file() and (images / n).stat().st_size == size for n, size in sizes.items())
        has_settings = survey is None and is_own and (beside / FILE_NAME).is_file()
        folder = beside if has_settings else survey_folder(loaded, survey)
    config = (settings_of(folder) or SurveyConfig()).field
    return replace(config, monocular=None if config.monocular is None else str((folder / config.monocular).absolute()))


def volume_options(config: FieldConfig, **others: Any) -> VolumeOptions:
    """`VolumeOptions` of a configuration; what it leaves open has its default, or is as its model's paper has it."""
    given = {name: value for name, value in vars(config).items() if value is not None} | others
    if given.pop("as_published"):
        model = given.get("model") or VolumeOptions.model
        published = MODELS[model].published if model in MODELS else {}
        if not published:
            raise SurveyError(f"--as-published is given, and no paper describes {model}; leave it out")
        taken = {name: value for name, value in published.items() if name not in given}
        given |= taken
        said = {**taken, **vars(taken.pop("losses", Losses()))}
        named = ", ".join(f"{name} {said[name]}" for name in said if name != "losses" and said[name])
        current().note(f"as published: {named or 'nothing'}; what is not as in the paper is in docs/papers.md")
    return VolumeOptions(**given)


# After a photograph's name without its suffix, with what each holds.
DEPTH, DISPARITY, NORMAL = _KINDS = "_depth", "_disparity", "_normal"
SUFFIXES = (".npy", ".tif", ".tiff", ".png")
# By which the shapes of a prior and of its photograph may differ: networks take multiples of 14 or 32 pixels.
_MOST_STRETCH = 0.05


def monocular_priors(folder: Path, names: Sequence[str], cameras: list[PinholeCamera]) -> list[PriorImages]:
    """Priors of photographs, empty where a photograph has no file.

    Of the photograph ``a/0001.jpg`` they are ``a/0001_depth``, or ``a/0001_disparity`` for its inverse, and
    ``a/0001_normal``, each ``.npy``, ``.tif`` or ``.png``. Depth is true up to a scale and a shift, and unknown where
    it is not finite, or 0 in whole numbers. Normals (height, width, 3) have the axes of the camera, x right, y down, z
    forward, and point at the camera; unsigned integers are ``2 value / maximum - 1``, with the maximum of their type.
    """
    if not folder.is_dir():
        raise SurveyError(f"{folder} is not a folder; expected one with monocular depth or normals of the photographs")
    found = [_priors(folder, name, camera) for name, camera in zip(names, cameras, strict=True)]
    if all(each.depth is None and each.normal is None for each in found):
        stem = Path(names[0]).with_suffix("")
        raise SurveyError(
            f"{folder} has no depth or normals of any of {len(names)} photographs; expected files such as "
            f"{stem}{DEPTH}.npy, {stem}{DISPARITY}.png or {stem}{NORMAL}.npy"
        )
    return found


def priors_hash(folder: Path) -> str:
    """Hash of the priors in a folder, by name and content."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.stem.endswith(_KINDS)]
    return hashlib.sha256(
        "".join(f"{path.relative_to(folder)}\0{content_hash(path)}\0" for path in files).encode()
    ).hexdigest()


def _priors(folder: Path, name: str, camera: PinholeCamera) -> PriorImages:
    depth, disparity, normal = (_file(folder, name, kind) for kind in (DEPTH, DISPARITY, NORMAL))
    if depth is not None and disparity is not None:
        raise SurveyError(f"{depth} and {disparity} are both there; keep one of depth and its inverse")
    given = depth or disparity
    return PriorImages(
        depth=None if given is None else _resized(_depth(given), given, camera),
        is_inverse=disparity is not None,
        normal=None if normal is None else _normals(normal, camera),
    )


def _file(folder: Path, name: str, kind: str) -> Path | None:
    stem = folder / Path(name).with_suffix("")
    return next((path for suffix in SUFFIXES if (path := stem.with_name(stem.name + kind + suffix)).is_file()), None)


def _read(path: Path, dimensions: int) -> np.ndarray:
    try:
        values = np.load(path, allow_pickle=False) if path.suffix == ".npy" else cv2.imread(str(path), -1)
    except (OSError, ValueError, EOFError) as error:
        raise SurveyError(f"{path} cannot be read ({error})") from error
    if values is None or np.ndim(values) != dimensions or not np.issubdtype(np.asarray(values).dtype, np.number):
        shape = "nothing" if values is None else f"an array {np.shape(values)}"
        expected = "(height, width)" if dimensions == 2 else "(height, width, 3)"
        raise SurveyError(f"{path} holds {shape}, expected numbers {expected}")
    return values


def _depth(path: Path) -> np.ndarray:
    values = _read(path, 2)
    known = np.isfinite(values) if np.issubdtype(values.dtype, np.floating) else values > 0
    return np.where(known, values, np.nan).astype(np.float32)


def _normals(path: Path, camera: PinholeCamera) -> np.ndarray:
    """Unit normals (height, width, 3), local, of the camera's size."""
    values = _read(path, 3)
    if values.shape[2] != 3:
        raise SurveyError(f"{path} holds {values.shape[2]} channels, expected x, y and z")
    if path.suffix != ".npy":  # OpenCV has blue first
        values = values[..., ::-1]
    if np.issubdtype(values.dtype, np.floating):
        given = values.astype(np.float32)
    else:
        given = np.float32(2.0 / np.iinfo(values.dtype).max) * values - np.float32(1.0)
    length = np.linalg.norm(given, axis=-1, keepdims=True)
    normals = np.asarray(given / np.where(length > 0.5, length, np.nan), dtype=np.float32)
    is_away = normals[..., 2][np.isfinite(normals[..., 2])] > 0.0
    share_away = float(is_away.mean()) if is_away.size else 0.0
    if share_away > 0.5:
        raise SurveyError(
            f"{path}: {100 * share_away:.0f} % of its normals point away from the camera; expected axes x right, y "
            "down, z forward, in which z of a normal that points at the camera is negative"
        )
    return _resized(normals, path, camera) @ camera.cam_from_local.astype(np.float32)


def _resized(values: np.ndarray, path: Path, camera: PinholeCamera) -> np.ndarray:
    height, width = values.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1.0) > _MOST_STRETCH:
        raise SurveyError(
            f"{path} is {width} x {height} px, and its photograph is {camera.width} x {camera.height}; expected the "
            "same ratio of width to height"
        )
    return cv2.resize(values, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
