"""What does a survey of shallow water look like? Draws the depth of a run for docs/gallery.md.

    python benchmarks/draw_survey.py RUN [-o FOLDER]

RUN is a finished run; that of the documentation is of wreck_water, standard. Some minutes of one core.
"""

import argparse
import io
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize
from matplotlib.figure import Figure
from PIL import Image

from bathynerf import Run
from survey.display.palette import DEPTHS

IMAGES = Path(__file__).resolve().parent.parent / "docs" / "img"
# Cells of the map [m], and colours that the picture is stored with.
CELL_M, NUM_COLOURS = 0.05, 200


def draw_depth(run: Run) -> Figure:
    """True depth of the bed in plan, shaded by its relief, in metres from the south-western corner."""
    dem = run.dem(CELL_M)
    scale = Normalize(*np.nanquantile(dem.depth, [0.01, 0.99]))
    height = np.where(np.isfinite(dem.height), dem.height, np.nanmedian(dem.height))
    shade = LightSource(315, 45).hillshade(height, vert_exag=1.5, dx=CELL_M, dy=CELL_M)[..., None]
    rgb = np.clip(DEPTHS(scale(np.nan_to_num(dem.depth)))[..., :3] * (0.45 + 0.75 * shade), 0.0, 1.0)
    rgb[~np.isfinite(dem.depth)] = 1.0
    figure = Figure(figsize=(6.6, 6.0), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    rows, columns = dem.depth.shape
    axes.imshow(rgb, extent=(0.0, columns * CELL_M, 0.0, rows * CELL_M), interpolation="bilinear")
    axes.set(xlabel="east [m]", ylabel="north [m]")
    figure.colorbar(ScalarMappable(scale, DEPTHS), ax=axes, shrink=0.8, label="true depth [m]").ax.invert_yaxis()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=IMAGES)
    given = parser.parse_args()
    content = io.BytesIO()
    draw_depth(Run.open(given.run)).savefig(content, format="png")
    # With a palette a picture takes a third of the bytes.
    Image.open(content).convert("RGB").quantize(NUM_COLOURS).save(given.output / "survey-depth.png", optimize=True)


if __name__ == "__main__":
    main()
