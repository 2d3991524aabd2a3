"""The rows of bench_adjust.py: survey folders as someone would have them, made from surveys whose truth is known."""

import io
import os
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import tomli_w
from PIL import ExifTags, Image

from survey.adjust.applied import apply_adjustment, write_cameras
from survey.adjust.refine import adjust_survey
from survey.folder.survey import load_survey
from survey.simulate.drawn import DrawnScene, draw_survey


def copy_without_gps(source: Path, target: Path) -> None:
    """Copy a JPEG file without its position."""
    raw = source.read_bytes()
    exif = Image.open(io.BytesIO(raw)).getexif()
    exif.pop(ExifTags.Base.GPSInfo, None)
    start, parts = 2, []
    while raw[start + 1] != 0xDA:
        end = start + 2 + int.from_bytes(raw[start + 2 : start + 4], "big")
        if raw[start + 4 : start + 8] != b"Exif":
            parts.append(raw[start:end])
        start = end
    data = exif.tobytes()
    data = data if data.startswith(b"Exif") else b"Exif\0\0" + data
    head = b"\xff\xd8\xff\xe1" + (len(data) + 2).to_bytes(2, "big") + data
    target.write_bytes(head + b"".join(parts) + raw[start:])


ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("BATHYNERF_DATA", ROOT.parent / "shared" / "data"))
GPS_STD_M = [0.02, 0.02, 0.02]
NOISY_STD_M, NOISY_STD_DEG = 0.02, 0.02
# Behind the folder of a field survey: from all that is true.
TRUE = ":true"


@dataclass(frozen=True)
class Truth:
    """What a row is measured against.

    Attributes
    ----------
    water : dict
        level_m, slope_east, slope_north, refractive_index; empty where there is none.
    lens : dict
        f, cx, cy [px], k1, k2, p1, p2.
    cameras : Path or None
        cameras.csv of the true poses.
    reference, visible, checkpoints : Path or None
    """

    water: dict[str, float] = field(default_factory=dict)
    lens: dict[str, float] = field(default_factory=dict)
    cameras: Path | None = None
    reference: Path | None = None
    visible: Path | None = None
    checkpoints: Path | None = None


@dataclass(frozen=True)
class Row:
    """A survey folder that is ready to be processed, its truth, and the quality and options to process it with."""

    survey: Path
    truth: Truth
    quality: str = "standard"
    kind: str = "drawn"
    options: tuple[str, ...] = ()


def prepare(name: str, folder: Path) -> Row:
    """The row of a name, or of a field survey, with ``:true`` behind it from its true poses, lens and water.

    The survey that is to be processed is written into `folder`.
    """
    if name in ROWS:
        return ROWS[name](folder)
    source, known = Path(name.removesuffix(TRUE)), name.endswith(TRUE)
    if not (source / "truth" / "truth.toml").is_file():
        raise SystemExit(f"{name} is neither a field survey nor one of {', '.join(ROWS)}")
    return _known(source, folder) if known else _field(source, folder)


def linked(source: Path, folder: Path, table: dict, *files: str) -> None:
    """A survey folder with the images of another one, some of its files and other settings."""
    folder.mkdir(parents=True)
    (folder / "images").symlink_to((source / "images").resolve())
    for name in files:
        shutil.copy(source / name, folder / name)
    (folder / "survey.toml").write_text(tomli_w.dumps(table), encoding="utf-8")


def settings_of(source: Path) -> dict:
    return tomllib.loads((source / "survey.toml").read_text(encoding="utf-8"))


def true_lens(table: dict) -> dict[str, float]:
    """From focal_px, principal_point_px and distortion (OPENCV)."""
    names = ("f", "cx", "cy", "k1", "k2", "p1", "p2")
    values = [table["focal_px"], *table["principal_point_px"], *table.get("distortion", (0.0,) * 4)]
    return dict(zip(names, values, strict=True))


def true_water(table: dict) -> dict[str, float]:
    names = ("level_m", "slope_east", "slope_north", "refractive_index")
    return {name: table.get(name, 0.0) for name in names}


def _drawn_truth(source: Path) -> Truth:
    """Of a survey that comes with exact poses, lens and water."""
    table = settings_of(source)
    return Truth(
        water=true_water(table["water"]),
        lens=true_lens(table["cameras"]),
        cameras=source / "cameras.csv",
        reference=source / "reference.ply",
        visible=source / "visible.ply",
    )


def _shore(folder: Path, *, controlled: bool) -> Row:
    source, table = DATA / "shore", settings_of(DATA / "shore")
    files = ("gcp_list.txt", "checkpoints.csv") if controlled else ()
    if not controlled:
        del table["control"]
    linked(source, folder, table, *files)
    return Row(folder, _shore_truth(source))


def _shore_blind(folder: Path) -> Row:
    """Shore without GPS: control alone says where it lies."""
    source, table = DATA / "shore", settings_of(DATA / "shore")
    del table["cameras"]["position_std_m"]
    linked(source, folder, table, "gcp_list.txt", "checkpoints.csv")
    (folder / "images").unlink()
    (folder / "images").mkdir()
    for path in sorted((source / "images").iterdir()):
        copy_without_gps(path, folder / "images" / path.name)
    return Row(folder, _shore_truth(source))


def _shore_known(folder: Path) -> Row:
    """Shore from its true poses, lens and water: what the adjustment can gain at most."""
    source, table = DATA / "shore", settings_of(DATA / "shore")
    true = tomllib.loads((source / "truth.toml").read_text(encoding="utf-8"))
    del table["control"], table["cameras"]["position_std_m"], table["water"]["level_std_m"]
    table["cameras"] |= {name: true[name] for name in ("focal_px", "principal_point_px", "distortion")}
    table["cameras"]["poses"] = "cameras_true.csv"
    table["water"] |= {name: true[name] for name in ("level_m", "refractive_index")}
    linked(source, folder, table, "cameras_true.csv")
    return Row(folder, _shore_truth(source))


def _shore_truth(source: Path) -> Truth:
    true = tomllib.loads((source / "truth.toml").read_text(encoding="utf-8"))
    return Truth(
        water=true_water(true),
        lens=true_lens(true),
        cameras=source / "cameras_true.csv",
        reference=source / "reference.ply",
        visible=source / "visible.ply",
        checkpoints=source / "checkpoints.csv",
    )


def _field(source: Path, folder: Path) -> Row:
    names = [name for name in ("gcp_list.txt", "checkpoints.csv") if (source / name).is_file()]
    linked(source, folder, settings_of(source), *names)
    return Row(folder, field_truth(source))


def _known(source: Path, folder: Path) -> Row:
    """A field survey of which poses, lens and water are known."""
    folder.mkdir(parents=True)
    (folder / "images").symlink_to((source / "images").resolve())
    for name in ("survey.toml", "cameras.csv"):
        shutil.copy(source / "truth" / name, folder / name)
    return Row(folder, field_truth(source))


def field_truth(source: Path) -> Truth:
    """Of a field survey that field_surveys.py drew."""
    true = tomllib.loads((source / "truth" / "truth.toml").read_text(encoding="utf-8"))
    return Truth(
        water=true_water(true),
        lens=true_lens(true),
        cameras=source / "truth" / "cameras.csv",
        reference=source / "truth" / "reference.ply",
        visible=source / "truth" / "visible.ply",
        checkpoints=source / "checkpoints.csv",
    )


def _gps_only(name: str, quality: str, folder: Path, *, level: bool = True) -> Row:
    """A drawn survey from its photographs and their GPS."""
    source, table = DATA / name, settings_of(DATA / name)
    del table["cameras"]["poses"], table["local"]
    table["cameras"]["position_std_m"] = GPS_STD_M
    if not level:
        del table["water"]["level_m"]
    linked(source, folder, table)
    return Row(folder, _drawn_truth(source), quality)


def _straight(name: str, quality: str, folder: Path) -> Row:
    """From poses and lens that were adjusted as if there were no water, which is put back afterwards.

    What refraction inside the adjustment is worth: the bend that is left here.
    """
    row = _gps_only(name, quality, folder)
    table, dry = settings_of(folder), folder.parent / "straight"
    linked(DATA / name, dry, {key: value for key, value in table.items() if key != "water"})
    survey = load_survey(dry, workspace=dry / "sfm")
    survey = apply_adjustment(survey, adjust_survey(survey))
    write_cameras(folder, survey)
    table |= {"cameras": {"poses": "sparse"}, "local": {"origin": list(survey.frame.origin)}}
    (folder / "survey.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    return replace(row, options=("--poses", "fixed"))


def _quick_noisy(folder: Path) -> Row:
    source, table = DATA / "quick", settings_of(DATA / "quick")
    noisy(source, folder, table)
    return Row(folder, _drawn_truth(source))


def noisy(source: Path, folder: Path, table: dict) -> None:
    """A survey folder with errors of 2 cm and 0.02 degrees in its poses, stated; see `linked`."""
    table["cameras"] |= {"position_std_m": [NOISY_STD_M] * 3, "rotation_std_deg": NOISY_STD_DEG}
    linked(source, folder, table)
    rng = np.random.default_rng(1)
    head, *lines = (source / "cameras.csv").read_text(encoding="utf-8").split()
    rows = [head]
    for line in lines:
        image, *values = line.split(",")
        noise = rng.standard_normal(6) * ([NOISY_STD_M] * 3 + [NOISY_STD_DEG] * 3)
        rows.append(",".join([image, *(f"{float(v) + d:.8f}" for v, d in zip(values, noise, strict=True))]))
    (folder / "cameras.csv").write_text("\n".join([*rows, ""]), encoding="utf-8")


def _quick(folder: Path) -> Row:
    source = DATA / "quick"
    linked(source, folder, settings_of(source), "cameras.csv")
    return Row(folder, _drawn_truth(source))


def _brighton(folder: Path) -> Row:
    source = DATA / "real" / "brighton_beach"
    # Land but for three photographs of the shoreline: without water. A receiver without corrections.
    table = {"crs": "EPSG:32615+3855", "cameras": {"position_std_m": [2.0, 2.0, 4.0]}}
    linked(source, folder, table)
    return Row(folder, Truth(reference=source / "model.laz"), kind="brighton")


def _copr(folder: Path) -> Row:
    """Every third control point (gcp02, 05, 08) is left out; a receiver in the hand, and no heights (0)."""
    source = DATA / "real" / "copr_half"
    table = {"crs": "EPSG:32611+3855", "control": {"gcps": "gcp_list.txt", "std_m": [1.0, 10.0]}}
    linked(source, folder, table)
    head, *lines = (source / "gcp_list.txt").read_text(encoding="utf-8").strip().splitlines()
    points = sorted({line.split()[-1] for line in lines})
    used = [_halved(line) for line in lines if line.split()[-1] not in points[2::3]]
    left_out = [_halved(line) for line in lines if line.split()[-1] in points[2::3]]
    (folder / "gcp_list.txt").write_text("\n".join([head, *used, ""]), encoding="utf-8")
    (folder / "left_out.txt").write_text("\n".join([head, *left_out, ""]), encoding="utf-8")
    return Row(folder, Truth(), "draft", kind="copr")


def _halved(line: str) -> str:
    """A line of gcp_list.txt for photographs of half the size; pixels count from the centre of the first one."""
    e, n, h, u, v, image, point = line.split()
    u, v = (0.5 * (float(c) + 0.5) - 0.5 for c in (u, v))
    return f"{e} {n} {h} {u:.3f} {v:.3f} {image} {point}"


ROWS: dict[str, Callable[[Path], Row]] = {
    "shore": lambda folder: _shore(folder, controlled=True),
    "shore_true": _shore_known,
    "shore_free": lambda folder: _shore(folder, controlled=False),
    "shore_blind": _shore_blind,
    "river_gps": lambda folder: _gps_only("river", "standard", folder),
    "wreck_gps": lambda folder: _gps_only("wreck_water", "draft", folder),
    "river_straight": lambda folder: _straight("river", "draft", folder),
    "river_no_level": lambda folder: _gps_only("river", "standard", folder, level=False),
    "wreck_no_level": lambda folder: _gps_only("wreck_water", "draft", folder, level=False),
    "quick_noisy": _quick_noisy,
    "quick": _quick,
    "brighton": _brighton,
    "copr": _copr,
}


READOUT_S, SPEED_M_S = 0.03, 5.0
EXACT, NOISY, GPS = "", "_noisy", "_gps"
# What the survey says of its shutter: how it is drawn [s], and keys of [cameras].
SAID: dict[str, tuple[float, dict[str, float]]] = {
    "shutter_global": (0.0, {"rolling_shutter_s": 0.0}),
    "shutter_known": (READOUT_S, {"rolling_shutter_s": READOUT_S}),
    "shutter_found": (READOUT_S, {"rolling_shutter_s": 0.02, "rolling_shutter_std_s": 0.02}),
    "shutter_ignored": (READOUT_S, {}),
}


def _row(name: str, folder: Path, *, poses: str) -> Row:
    readout, keys = SAID[name]
    source = folder.parent.parent / f"drawn_{readout:g}"
    scene = DrawnScene(
        num_views=21, flying_m=22.0, focal_px=900.0, image_px=(600, 450), seed=41, speed_m_s=SPEED_M_S,
        readout_s=readout,
    )  # fmt: skip
    draw_survey(source, scene)
    table = settings_of(source)
    true = Truth(
        water=true_water(table["water"]),
        lens=true_lens(table["cameras"]) | {"readout_s": readout},
        cameras=source / "cameras.csv",
        reference=source / "truth" / "reference.ply",
        visible=source / "truth" / "visible.ply",
    )
    table["cameras"].pop("rolling_shutter_s", None)
    table["cameras"] |= keys
    if poses == NOISY:
        noisy(source, folder, table)
    elif poses == GPS:
        del table["cameras"]["poses"]
        table["cameras"]["position_std_m"] = GPS_STD_M
        linked(source, folder, table)
    else:
        linked(source, folder, table, "cameras.csv")
    return Row(folder, true)


SHUTTER_ROWS: dict[str, Callable[[Path], Row]] = {
    name + poses: partial(_row, name, poses=poses) for poses in (EXACT, NOISY, GPS) for name in SAID
}
