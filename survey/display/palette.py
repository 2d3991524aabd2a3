"""The colours of all pictures and of the report, named by their meaning."""

from matplotlib.colors import LinearSegmentedColormap

# Text and axes; secondary text; places without data; the ground under a cut.
INK, SOFT, EMPTY = "#22303c", "#5d6a76", "#d9dde1"
# Measured values, their reference, and a pale field behind both.
BLUE, RED, PALE = "#2f6f9f", "#c3140d", "#e8eef3"
WATER, WATER_LINE, LAND, OBLIQUE, BOUNDS = "#8fc3d3", "#4f94ad", "#d8c9a6", "#d98032", "#c2452d"
# Distributions shown side by side.
SERIES = ("#3a6e97", "#8a4f7d", "#4b8b6f", "#c07c3e")
# Colours of a verdict, dark enough to be read as text on white.
PASSED, DOUBTFUL, FAILED = "#1f7a3d", "#8f5600", "#b3261e"

# Light and yellowish where shallow, dark blue where deep; lightness falls steadily.
DEPTHS = LinearSegmentedColormap.from_list(
    "depths", ["#fbf9cf", "#c6e6a8", "#7fcaa5", "#48a9a8", "#3a86a8", "#41649d", "#484884", "#3c2d5e"]
)
HEIGHTS = LinearSegmentedColormap.from_list(
    "heights", ["#3f5d54", "#7d9a6b", "#c9c58b", "#d9b07a", "#b4795c", "#f1e8e2"]
)
DRY_GROUND = LinearSegmentedColormap.from_list("dry ground", ["#77746e", "#c8c4bb"])
NOT_REACHED = LinearSegmentedColormap.from_list("not reached", ["#c9d6df", "#f0a48c", RED])
DIFFERENCES, SIZES, SPREADS, COUNTS = "RdBu_r", "viridis", "magma_r", "viridis"
