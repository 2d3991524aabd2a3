"""Images (height, width) between the kernels of the sweep: filters, tiles and strips of heights and scores, planes.

They lie in the memory of the host, whatever the device of the kernels. Planes are fitted to the heights around a pixel:
to extrapolate the bed, and for slopes, walls and edges.
"""

import cv2
import numpy as np

from fields.sweep.tiles import in_tiles

_SMOOTH_PX = 5  # Side of the box filter of heights before their gradient is taken [px]
_SINGLE_PX = 5  # Side of the median filter of the heights of a coarser pass [px]
_NEIGHBOURHOOD = np.ones((3, 3), dtype=np.uint8)  # A pixel and its eight neighbours


def median_above(image: np.ndarray, least: float) -> float | None:
    """Median of the pixels above a value; None without any."""
    above = image[image > least]
    return median(above) if len(above) else None


def local_min_max(height: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Minimum and maximum height within a radius [px] of each pixel, after a median filter."""
    kernel = np.ones((2 * radius + 1,) * 2, dtype=np.uint8)
    height = cv2.medianBlur(height, 3)
    return cv2.erode(height, kernel), cv2.dilate(height, kernel)


def upsample(height: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Heights of a coarser pass at another shape, bilinear, after a median filter."""
    if height.shape == shape:
        return height
    return cv2.medianBlur(cv2.resize(height, shape[::-1], interpolation=cv2.INTER_LINEAR), _SINGLE_PX)


def masked_means(value: np.ndarray, mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Means of the masked values over the areas of larger pixels, (height, width) float32; NaN where none is."""
    known = mask.astype(np.float32)
    share, total = (cv2.resize(each, shape[::-1], interpolation=cv2.INTER_AREA) for each in (known, known * value))
    return np.where(share > 0.0, total / np.maximum(share, 1e-6), np.float32(np.nan)).astype(np.float32)


def newly_visible(height: np.ndarray, num_agreeing: np.ndarray | None) -> np.ndarray:
    """Pixels with a height that no steeper view has, dilated by a pixel: (height, width) bool.

    ``num_agreeing`` (height * width) is the number of steeper views that agree with it; None where there are none.
    """
    is_selected = np.isfinite(height)
    if num_agreeing is not None:
        is_selected &= num_agreeing.reshape(is_selected.shape) == 0.0
    return cv2.dilate(is_selected.astype(np.uint8), _NEIGHBOURHOOD).astype(bool)


def fill_nearest(height: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Heights with unknown ones replaced by that of the nearest known pixel.

    Otherwise they would stay at the lowest hypothesis in all views alike, and seem to agree.
    """
    if known.all() or not known.any():
        return height
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.empty(nearest.max() + 1, dtype=np.float32)
    of_label[nearest[known]] = height[known]
    return of_label[nearest]


def strip_indices(strip: tuple[slice, slice], width: int) -> np.ndarray:
    """Flat indices of a part of an image of a width."""
    rows, columns = strip
    return (np.arange(rows.start, rows.stop)[:, None] * width + np.arange(columns.start, columns.stop)).ravel()


def put_strip(
    target: np.ndarray, width: int, result: np.ndarray, part: tuple[slice, slice], strip: slice, radius: int
) -> None:
    """Copy the wanted rows and columns of a strip's results into a flat image of ``width`` columns.

    ``part`` (rows, columns): the wanted ones, in the image. ``strip``: columns of the image that the strip spans.
    ``radius`` [px]: of the windows: results begin with the first whole one, so many pixels into the first of the wanted
    rows.
    """
    image = np.pad(result, radius).reshape(-1, strip.stop - strip.start)
    columns = part[1]
    target.reshape(-1, width)[part] = image[:, columns.start - strip.start : columns.stop - strip.start]


def tile_extents(wanted: np.ndarray, low: np.ndarray, high: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Least low and largest high value of the wanted pixels of each tile, (rows, columns); inf if none."""
    # One axis after the other: numpy vectorises no reduction over both.
    least = in_tiles(np.where(wanted, low, np.inf), size, np.inf).min(axis=1).min(axis=2)
    most = in_tiles(np.where(wanted, high, -np.inf), size, -np.inf).max(axis=1).max(axis=2)
    return least, most


def tile_gradients(height: np.ndarray, wanted: np.ndarray, size: int) -> np.ndarray:
    """Gradient of smoothed heights along rows and columns by Sobel's kernel (8 times the rise), (rows, columns, 2) [m].

    The sum over the wanted pixels of each tile.
    """
    smooth = cv2.blur(cv2.medianBlur(height, 3), (_SMOOTH_PX, _SMOOTH_PX))
    rises = [cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((0, 1), (1, 0))]
    return np.stack([in_tiles(np.where(wanted, each, 0.0), size, 0.0).sum(axis=(1, 3)) for each in rises], axis=-1)


def median(values: np.ndarray) -> float:
    """Median of an array of any shape as numpy's: NaN where any value is NaN. (384, 512): 0.14 instead of 2.3 ms."""
    return float(median_reordering(values.flatten()))


def median_reordering(values: np.ndarray) -> np.floating:
    """The median of values (N,), which are reordered."""
    if not len(values):
        raise ValueError("the median of no values is asked for; expected one or more")
    half = len(values) // 2
    values.partition(half)
    most = values[half:].max()
    if np.isnan(most):
        return most
    return values[half] if len(values) % 2 else (values[:half].max() + values[half]) / values.dtype.type(2.0)


# Heights around a pixel on a wall lie in one plane: residuals (rms) below this share of its slope. A step has 0.47.
_MOST_BENT = 0.4
# An edge is located to the windows of the sweep only: heights within this square may be those of its pixel [px].
_NEAR_PX = 5
# Rise from column to column of the plane through 3x3 heights.
_RISE = np.tile(np.array([-1.0, 0.0, 1.0], dtype=np.float32) / 6.0, (3, 1))


def steep_and_wall_pixels(height: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Steep pixels (height, width) bool, and those of them on a wall: in one plane with all around.

    Steep is what differs from the neighbours by more than what counts as agreement, ``tolerance`` [m].
    """
    slope = slope_of(height)
    # About the middle of the map: squares of large heights would lose the small ones.
    height = height - np.median(height)
    mean, square = (cv2.blur(each, (3, 3)) for each in (height, height * height))
    # Along its rise the squares of a plane are two thirds of that of its slope.
    off_plane = square - mean * mean - (2.0 / 3.0) * slope * slope
    steep = slope > tolerance
    return steep, steep & (off_plane < (_MOST_BENT * slope) ** 2)


def half_range(height: np.ndarray) -> np.ndarray:
    """Half of the range of the heights within two pixels, (height, width) [m]."""
    about = np.ones((_NEAR_PX, _NEAR_PX), np.uint8)
    return 0.5 * (cv2.dilate(height, about) - cv2.erode(height, about))


def slope_of(height: np.ndarray) -> np.ndarray:
    """Slope (height, width) float32 [m per pixel] of the plane through 3x3 heights."""
    return cv2.magnitude(*gradient_of(height))


def gradient_of(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of that plane along columns and rows, (height, width) float32 [m per pixel] each."""
    across, down = (cv2.filter2D(height, -1, kernel) for kernel in (_RISE, _RISE.T))
    return across, down


SIDE_PX = 13  # Side of the square of heights through which a plane is fitted [px]
# Of the square, at least such a share has to be known; and known pixels spread by so much [px], or they lie in a line.
_LEAST_KNOWN, _LEAST_SPREAD_PX = 0.1, 1.0
_ROWS = 64  # Rows that are worked out together, of 200 bytes a pixel


def extrapolate_planes(height: np.ndarray, known: np.ndarray, tolerance: float) -> np.ndarray:
    """Heights with unknown ones taken from the plane through the known ones around, where these lie in one.

    ``height`` (height, width) float32 [m]. ``known`` (height, width) bool. ``tolerance`` [m]: known heights lie in a
    plane if they leave it (rms) by less. Beside an edge they do not, and nothing is changed. Returns (height, width)
    float32 [m].
    """
    found, halo = height.copy(), SIDE_PX // 2
    for first in range(0, len(height), _ROWS):
        rows = slice(first, first + _ROWS)
        around = slice(max(first - halo, 0), first + _ROWS + halo)
        seen = np.flatnonzero(known[around].any(axis=0))
        if known[rows].all() or not len(seen):
            continue
        # A window shows a tile of the ground in a part of its columns.
        columns = slice(max(seen[0] - halo, 0), seen[-1] + halo + 1)
        plane, off = _planes(height[around, columns], known[around, columns])
        inner = slice(first - around.start, first - around.start + len(height[rows]))
        take = ~known[rows, columns] & (off[inner] < tolerance)
        found[rows, columns][take] = plane[inner][take]
    return found


def _planes(height: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height at each pixel of the plane through the known ones in the square about it, and how far these leave it.

    The latter, a root mean square, is infinite where too few are known, or in a line.
    """
    weight = known.astype(np.float32)
    base = np.float32(np.vdot(weight.astype(np.float64), height) / np.count_nonzero(known))
    over_base = weight * (height - base)
    w0, w1, w2 = (_along(weight, power, 0) for power in range(3))
    z0, z1 = (_along(over_base, power, 0) for power in range(2))
    n = _along(w0, 0, 1)
    # Means over the known pixels of places x, y from the middle, heights z, and their products.
    each = 1.0 / np.maximum(n, 0.5)
    x, y, z = _along(w1, 0, 1) * each, _along(w0, 1, 1) * each, _along(z0, 0, 1) * each
    xx, yy, xy = (
        _along(w2, 0, 1) * each - x * x, _along(w0, 2, 1) * each - y * y, _along(w1, 1, 1) * each - x * y
    )  # fmt: skip
    xz, yz, zz = (
        _along(z1, 0, 1) * each - x * z, _along(z0, 1, 1) * each - y * z, _over(over_base * over_base) * each - z * z
    )  # fmt: skip
    # The determinant over the trace is nearly the variance in the direction in which the pixels spread least.
    spread = xx * yy - xy * xy
    enough = (n >= _LEAST_KNOWN * SIDE_PX**2) & (spread > _LEAST_SPREAD_PX**2 * (xx + yy))
    over = 1.0 / np.where(enough, spread, 1.0)
    across, down = (yy * xz - xy * yz) * over, (xx * yz - xy * xz) * over
    off = np.sqrt(np.maximum(zz - across * xz - down * yz, 0.0))
    return base + (z - across * x - down * y), np.where(enough, off, np.inf)


def _over(values: np.ndarray) -> np.ndarray:
    """Sums over the square."""
    return cv2.boxFilter(values, -1, (SIDE_PX, SIDE_PX), normalize=False, borderType=cv2.BORDER_CONSTANT)


def _along(values: np.ndarray, power: int, axis: int) -> np.ndarray:
    """Sums over a side of the square of values times a power of the distance [px], along rows (0) or columns (1)."""
    kernels = [np.ones(1), (np.arange(SIDE_PX) - SIDE_PX // 2.0) ** power]
    along, other = kernels[::-1] if axis == 0 else kernels
    return cv2.sepFilter2D(values, -1, along, other, borderType=cv2.BORDER_CONSTANT)
