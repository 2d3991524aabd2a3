"""Tables and pictures of docs/notes/field.md from the rows of `bench_field`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from gallery_canvas import canvas, save
from PIL import Image

from survey.display.palette import INK, SOFT

DOCS = Path(__file__).resolve().parents[1] / "docs"
LABELS = {
    "vm": "VM", "dw": "DW", "m": "M", "mdw": "MDW", "tensorf": "TensoRF", "nerf": "NeRF", "tinynerf": "TinyNeRF",
    "hash": "hash grid, proposals", "neus": "signed distance",
}  # fmt: skip
# What the object fills of its held-out photograph, in shares of its sides: left, right, top, bottom.
PARTS = {"wreck": (0.28, 0.74, 0.24, 0.74), "ship": (0.38, 0.66, 0.05, 0.92), "hull": (0.15, 0.85, 0.24, 0.70)}
# By which differences are enlarged, and how high a picture of a row may be [inch].
TIMES, _HIGHEST_IN = 4.0, 3.2
HEAD = (
    "| object | model | held-out PSNR | Chamfer distance | parameters | memory to render | a step | rays/s rendered |",
    "|---|---|---|---|---|---|---|---|",
)


def ablation_table(rows: list[dict], models: tuple[str, ...]) -> str:
    """Markdown: each object's models, with ratios to its first one."""
    lines = []
    for name in dict.fromkeys(r["object"] for r in rows):
        of = {r["model"]: r for r in rows if r["object"] == name and r["model"] in models}
        base = of.get(models[0])
        for model in (m for m in models if m in of):
            lines.append("| " + " | ".join([name, LABELS[model], *_columns(of[model], base)]) + " |")
    return "\n".join([*HEAD, *lines]) if lines else ""


def _columns(row: dict, base: dict | None) -> list[str]:
    def ratio(key: str) -> str:
        return "" if base is None or row is base else f" (x {row[key] / base[key]:.2f})"

    gain = "" if base is None or row is base else f" ({row['held_out_psnr_db'] - base['held_out_psnr_db']:+.2f})"
    return [
        f"{row['held_out_psnr_db']:.2f} dB{gain}",
        f"{1e3 * row['chamfer_m']:.1f} mm{ratio('chamfer_m')}",
        f"{row['parameters_mb']:.2f} MB{ratio('parameters_mb')}",
        f"{row['inference_mb']:.0f} MB{ratio('inference_mb')}",
        f"{1e3 * row['step_s']:.0f} ms{ratio('step_s')}",
        f"{row['rays_per_s'] / 1e3:.0f} k",
    ]


def baseline_table(rows: list[dict], models: tuple[str, ...]) -> str:
    """Markdown: the other fields on the same photographs."""
    found = [r for r in rows if r["model"] in models]
    lines = ["| " + " | ".join([r["object"], LABELS[r["model"]], *_columns(r, None)]) + " |" for r in found]
    return "\n".join([*HEAD, *lines]) if lines else ""


def write_page(tables: dict[str, str], work: Path, objects: list[str], rows: list[dict]) -> None:
    """Replace the tables of docs/notes/field.md, each between its two marks, and its pictures."""
    page = DOCS / "notes" / "field.md"
    text = page.read_text(encoding="utf-8")
    for name, table in tables.items():
        if table:
            first, last = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
            start, end = text.index(first) + len(first), text.index(last)
            text = text[:start] + table + "\n" + text[end:]
    page.write_text(text, encoding="utf-8")
    for name in objects:
        of = {r["model"]: r for r in rows if r["object"] == name}
        draw_row(work, name, of, DOCS / "img" / f"field_{name}.png")


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
    plots[0, 0].set_title("photograph", loc="left", color=INK, fontsize=9.5)
    plots[1, 0].text(
        0.0, 0.5, f"difference,\ntimes {TIMES:g}", transform=plots[1, 0].transAxes, color=SOFT, va="center"
    )
    for (above, below), model in zip(plots.T[1:], models, strict=True):
        rendered = _part(work / f"{name}_{model}.png", name)
        above.imshow(rendered)
        psnr = rows[model]["held_out_psnr_db"]
        above.set_title(f"{LABELS[model]}, {psnr:.1f} dB", loc="left", color=INK, fontsize=9.5)
        apart = np.abs(rendered.astype(float) - photograph.astype(float)).mean(axis=2) / 255.0
        below.imshow(apart, cmap="gray_r", vmin=0.0, vmax=1.0 / TIMES)
    save(figure, path)


def _part(file: Path, name: str) -> np.ndarray:
    """The part of a picture (rows, columns, 3) that the object fills."""
    picture = np.asarray(Image.open(file).convert("RGB"))
    height, width = picture.shape[:2]
    x0, x1, y0, y1 = PARTS[name]
    return picture[round(y0 * height) : round(y1 * height), round(x0 * width) : round(x1 * width)]
