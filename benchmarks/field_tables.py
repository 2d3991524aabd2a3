"""Tables and pictures of the rows of `bench_field`."""

from __future__ import annotations

import statistics
from pathlib import Path

import numpy as np
from gallery_canvas import canvas, save, scale_bar
from PIL import Image
from scipy.special import stdtrit

from fields.models import MODELS
from survey.display.palette import INK, SOFT

DOCS = Path(__file__).resolve().parents[1] / "docs"
# What the object fills of its held-out photograph, in shares of its sides: left, right, top, bottom.
PARTS = {"wreck": (0.28, 0.74, 0.24, 0.74), "ship": (0.38, 0.66, 0.05, 0.92), "hull": (0.15, 0.85, 0.24, 0.70)}
# By which differences are enlarged, and how high a picture of a row may be [inch].
TIMES, _HIGHEST_IN = 4.0, 3.2
HEAD = (
    "| object | model | held-out PSNR | Chamfer distance | parameters | memory | steps | a step | rays/s rendered |",
    "|---|---|---|---|---|---|---|---|---|",
)
CONFIDENCE = 0.95


def table_of(rows: list[dict]) -> str:
    """Markdown: each object's models; of several seeds the mean, and half of the 95 % interval of the mean.

    Of PSNR and distance the difference and the ratio to the first model of the object stand in brackets, by seed.
    """
    lines = []
    for name in dict.fromkeys(r["object"] for r in rows):
        of = [r for r in rows if r["object"] == name]
        models = list(dict.fromkeys(r["model"] for r in of))
        base = [r for r in of if r["model"] == models[0]]
        for model in models:
            cells = _columns([r for r in of if r["model"] == model], None if model == models[0] else base)
            lines.append("| " + " | ".join([name, MODELS[model].label, *cells]) + " |")
    return "\n".join([*HEAD, *lines])


def _columns(rows: list[dict], base: list[dict] | None) -> list[str]:
    psnr, distance = ([f * r[key] for r in rows] for key, f in (("held_out_psnr_db", 1.0), ("chamfer_m", 1e3)))
    gain = ratio = ""
    if base is not None:
        gain = f" ({interval([r - b['held_out_psnr_db'] for r, b in zip(psnr, base, strict=True)], 2, sign=True)})"
        ratio = f" (x {interval([1e-3 * r / b['chamfer_m'] for r, b in zip(distance, base, strict=True)], 2)})"
    memory = statistics.fmean(r["train_mb"] or r["steps_mb"] for r in rows)
    return [
        f"{interval(psnr, 2)} dB{gain}",
        f"{interval(distance, 1)} mm{ratio}",
        f"{rows[0]['parameters_mb']:.2f} MB",
        f"{memory:.0f} MB",
        f"{statistics.fmean(r['steps'] for r in rows):.0f}",
        f"{1e3 * rows[0]['step_s']:.1f} ms",
        f"{statistics.fmean(r['rays_per_s'] for r in rows) / 1e3:.0f} k",
    ]


def interval(values: list[float], digits: int, *, sign: bool = False) -> str:
    """The mean, and where there are several values half of the interval that holds it with `CONFIDENCE` (Student)."""
    mean = f"{statistics.fmean(values):{'+' if sign else ''}.{digits}f}"
    if len(values) == 1:
        return mean
    half = stdtrit(len(values) - 1, 0.5 + 0.5 * CONFIDENCE) * statistics.stdev(values) / len(values) ** 0.5
    return f"{mean} ± {half:.{digits}f}"


def draw_objects(work: Path, rows: list[dict]) -> None:
    """The pictures of docs/field.md, one for each object."""
    for each in dict.fromkeys(r["object"] for r in rows):
        of = {r["model"]: r for r in rows if r["object"] == each and r["seed"] == 0}
        draw_row(work, each, of, DOCS / "img" / f"field_{each}.png")


def draw_row(work: Path, name: str, rows: dict[str, dict], path: Path) -> None:
    """A held-out photograph beside what the models render of the object, and below how far each is from it."""
    photograph = _part(work / f"{name}_photograph.png", name)
    models = [model for model in rows if (work / f"{name}_{model}.png").exists()]
    height_over_width = photograph.shape[0] / photograph.shape[1]
    width = min(2.0, _HIGHEST_IN / height_over_width)
    size = (width * (len(models) + 1), 2.0 * width * height_over_width + 0.6)
    figure, plots = canvas(*size, nrows=2, ncols=len(models) + 1)
    for axes in plots.flat:
        axes.axis("off")
    plots[0, 0].imshow(photograph)
    scale_bar(plots[0, 0], next(iter(rows.values()))["px_per_m"])
    plots[0, 0].set_title("photograph", loc="left", color=INK, fontsize=9.5)
    plots[1, 0].text(
        0.0, 0.5, f"difference,\ntimes {TIMES:g}", transform=plots[1, 0].transAxes, color=SOFT, va="center"
    )
    for (above, below), model in zip(plots.T[1:], models, strict=True):
        rendered = _part(work / f"{name}_{model}.png", name)
        above.imshow(rendered)
        psnr = rows[model]["held_out_psnr_db"]
        above.set_title(f"{MODELS[model].label}, {psnr:.1f} dB", loc="left", color=INK, fontsize=9.5)
        apart = np.abs(rendered.astype(float) - photograph.astype(float)).mean(axis=2) / 255.0
        below.imshow(apart, cmap="gray_r", vmin=0.0, vmax=1.0 / TIMES)
    save(figure, path)


def _part(file: Path, name: str) -> np.ndarray:
    """The part of a picture (rows, columns, 3) that the object fills."""
    picture = np.asarray(Image.open(file).convert("RGB"))
    height, width = picture.shape[:2]
    x0, x1, y0, y1 = PARTS[name]
    return picture[round(y0 * height) : round(y1 * height), round(x0 * width) : round(x1 * width)]
