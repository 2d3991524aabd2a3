"""Draw docs/img/held_out.png: a photograph held out from training, beside the rendering of its view.

    python benchmarks/draw_held_out.py SURVEY WORK [--image 0116.jpg]

WORK is the folder of `bench_survey_field.py SURVEY -o WORK --rows held`. A minute after that has run.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from gallery_canvas import canvas, px_per_m, save, scale_bar
from matplotlib.patches import Rectangle
from PIL import Image

from survey.display.palette import INK, RED, SOFT
from survey.folder.survey import load_survey

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "img" / "held_out.png"
# Parts of the photograph, left, top, right, bottom [px]: what is shown whole, and the wreck.
WHOLE, WRECK = (0, 120, 1024, 601), (240, 215, 756, 457)
# Beyond so many grey levels differences have one shade.
MOST = 40.0


def main() -> None:
    """Read the photograph and its rendering, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("survey", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--image", default="0116.jpg")
    options = parser.parse_args()
    views = json.loads((options.work / "held.json").read_text(encoding="utf-8"))["views"]
    psnr_db = next(view["psnr_db"] for view in views if view["image"] == options.image)
    photograph = pixels(options.survey / "images" / options.image)
    rendered = (options.work / "views of held" / options.image).with_suffix(".png")
    draw(photograph, pixels(rendered), psnr_db, scale_of(options.survey, options.image, rendered))


def pixels(path: Path) -> np.ndarray:
    """A picture (height, width, 3) in grey levels."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def scale_of(survey: Path, image: str, rendered: Path) -> float:
    """Pixels that a metre covers along a row, level in the middle of the wreck, whose height was rendered."""
    loaded, (x0, y0, x1, y1) = load_survey(survey), WRECK
    camera = next(view.camera for view in loaded.views if view.name == image)
    with Image.open(rendered.with_name(f"{rendered.stem}_height.tif")) as heights:
        height = float(np.nanmedian(cut(np.asarray(heights), WRECK)))
    return px_per_m(camera, loaded.water, (0.5 * (x0 + x1), 0.5 * (y0 + y1)), height)


def draw(photograph: np.ndarray, rendered: np.ndarray, psnr_db: float, scale: float) -> None:
    """The photograph, the wreck in it, the same rendered, and their difference; so many pixels to the metre."""
    x0, y0, x1, y1 = WRECK
    figure, plots = canvas(8.4, 4.6, nrows=2, ncols=2)
    for axes in plots.flat:
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
    (whole, wreck), (apart, rendered_part) = plots
    whole.imshow(cut(photograph, WHOLE), extent=(WHOLE[0], WHOLE[2], WHOLE[3], WHOLE[1]))
    whole.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, ec=RED, lw=1.2))
    wreck.imshow(cut(photograph, WRECK))
    rendered_part.imshow(cut(rendered, WRECK))
    for axes in (whole, wreck, rendered_part):
        scale_bar(axes, scale)
    difference = np.abs(photograph.astype(float) - rendered).mean(axis=2)
    shades = apart.imshow(cut(difference, WRECK), cmap="gray_r", vmin=0.0, vmax=MOST)
    bar = figure.colorbar(shades, ax=apart, location="left", extend="max", shrink=0.8, pad=0.02)
    bar.set_label("difference [grey levels]", color=INK, fontsize=8.5)
    bar.ax.tick_params(colors=SOFT, labelsize=8.0)
    titles = (
        (whole, "A photograph that was left out"),
        (wreck, "The wreck, photographed"),
        (apart, "Where both differ"),
        (rendered_part, f"The wreck, rendered ({psnr_db:.1f} dB over the water)"),
    )
    for axes, title in titles:
        axes.set_title(title, loc="left", color=INK, fontsize=10)
    save(figure, PICTURE)


def cut(picture: np.ndarray, part: tuple[int, int, int, int]) -> np.ndarray:
    """A part of a picture (height, width, ...)."""
    x0, y0, x1, y1 = part
    return picture[y0:y1, x0:x1]


if __name__ == "__main__":
    main()
