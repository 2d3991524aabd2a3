"""Tables and pictures of docs/field.md from the rows of `bench_field`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

DOCS = Path(__file__).resolve().parents[1] / "docs"
LABELS = {
    "tensorf": "TensoRF", "dw": "DW", "m": "M", "mdw": "MDW", "nerf": "NeRF", "tinynerf": "TinyNeRF",
    "hash": "hash grid, proposals", "neus": "signed distance",
}  # fmt: skip
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


def write_page(tables: dict[str, str], work: Path, objects: list[str], models: list[str]) -> None:
    """Replace the tables of docs/field.md, each between its two marks, and its pictures."""
    page = DOCS / "field.md"
    text = page.read_text(encoding="utf-8")
    for name, table in tables.items():
        if table:
            first, last = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
            start, end = text.index(first) + len(first), text.index(last)
            text = text[:start] + table + "\n" + text[end:]
    page.write_text(text, encoding="utf-8")
    for name in objects:
        draw_row(work, name, models).save(DOCS / "img" / f"field_{name}.png")


def draw_row(work: Path, name: str, models: list[str]) -> Image.Image:
    """A held-out photograph beside what the models render."""
    files = [work / f"{name}_photograph.png", *(work / f"{name}_{m}.png" for m in models)]
    return Image.fromarray(np.hstack([np.asarray(Image.open(f).convert("RGB")) for f in files if f.exists()]))
