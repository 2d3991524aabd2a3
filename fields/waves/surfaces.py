"""One water surface for each photograph, found together with the bed from displacements of the bed.

Through a surface of height s over the plane of the water a photograph shows a point of the bed displaced by ``d``, a
linear function of s and its gradient where the ray crosses the plane (`fields.waves.waves.Crossings`). Photographs are
measured against their mean, from heights of the bed that are wrong by dz, and a displacement is

    y = d + parallax dz + m + noise,

with dz and the shift m of the mean (2,) free in each cell of the bed. The surface of a photograph is a cubic B-spline
with a Gaussian prior. The power spectrum of the prior, the same for all photographs, and the variance of the noise are
those of the largest restricted likelihood, by expectation maximisation (Dempster et al. 1977). The posterior mean is
found by conjugate gradients; how wrong it is, by random draws of surfaces and noise, which are solved in the same way
(Papandreou and Yuille 2010).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft, ndimage, sparse

# Steps of expectation maximisation, and the power of its factors that are applied at once: more converge faster.
ROUNDS, HASTE = 6, 1.5
# Draws whose errors are kept: of the last steps, and after these. What is wrong with all of the block is in each once.
DRAWS, MORE_DRAWS = 3, 5
# Conjugate gradients: most steps, and the residual relative to the first at which they end.
CG_STEPS, CG_RESIDUAL = 120, 5e-3
# Power spectra are smoothed by a Gauss filter of this standard deviation, in steps of the Fourier transform.
SPECTRUM_STD = 0.8
# Power of the first spectrum falls with this power of the wave number, from waves of this many spacings on. Where it
# falls more steeply than that of the sea, a bend that all surfaces share stands in for the short waves that it leaves:
# it scales displacements, as rays are those to displaced points.
START_SLOPE, START_LENGTH = -4.5, 60.0
# Of a normal distribution, the share within one standard deviation.
_ONE_STD = 0.6827
# Margin of a surface about the crossings, in spacings: surfaces are periodic.
MARGIN = 6


@dataclass(frozen=True)
class Displacements:
    """M displacements of cells of the bed in photographs, along the plane of the water."""

    cell: np.ndarray  # (M,) int
    view: np.ndarray  # (M,) int: photograph
    crossing: np.ndarray  # (M, 2) [m]: where the ray enters the water
    by_gradient: np.ndarray  # (M, 2, 2) [m]: change with the gradient of the surface
    by_height: np.ndarray  # (M, 2): change with its height
    parallax: np.ndarray  # (M, 2): change with the height of the bed
    measured: np.ndarray  # (M, 2) [m]
    information: np.ndarray  # (M, 2, 2) [1/m^2]

    @property
    def size(self) -> np.ndarray:
        """Mean information (M,) along an axis."""
        return 0.5 * np.trace(self.information, axis1=1, axis2=2)


class CellAdjustment:
    """Least squares for what is free in each cell: height (0) and shift (1, 2), by the information of displacements."""

    def __init__(self, cell: np.ndarray, parallax: np.ndarray, information: np.ndarray):
        count, num = len(cell), int(cell.max()) + 1
        self._cell, self._information = cell, information.astype(np.float32)
        self._sums = sparse.csr_matrix((np.ones(count, np.float32), cell, np.arange(count + 1)), shape=(count, num)).T
        by = np.zeros((count, 2, 3))
        by[:, :, 0], by[:, 0, 1], by[:, 1, 2] = parallax, 1.0, 1.0
        self._by = by.astype(np.float32)
        normal = (self._sums @ (by.swapaxes(1, 2) @ information @ by).reshape(count, 9)).reshape(num, 3, 3)
        # Nothing is known of the height of a cell that is seen along one direction alone.
        slack = 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-9
        self._inverse = np.linalg.inv(normal + slack * np.eye(3)).astype(np.float32)
        self.degrees_of_freedom = 2 * count - 3 * num

    def weighted(self, displacement: np.ndarray) -> np.ndarray:
        """Information times displacements (M, 2)."""
        return np.einsum("mab,mb->ma", self._information, displacement)

    def free(self, weighted: np.ndarray) -> np.ndarray:
        """What is free (C, 3) from weighted displacements (M, 2)."""
        return np.einsum("cab,cb->ca", self._inverse, self._sums @ np.einsum("mba,mb->ma", self._by, weighted))

    def by_free(self, weighted: np.ndarray) -> np.ndarray:
        """Displacements (M, 2) by what is free, from weighted displacements (M, 2)."""
        return np.einsum("mab,mb->ma", self._by, self.free(weighted)[self._cell])

    def left(self, weighted: np.ndarray) -> np.ndarray:
        """Weighted displacements (M, 2) minus those by what is free."""
        return weighted - self.weighted(self.by_free(weighted))


class SurfaceGrid:
    """B-splines over the crossings of V photographs, on rasters of one shape, and their Fourier transforms."""

    def __init__(self, crossing: np.ndarray, view: np.ndarray, num_views: int, spacing: float):
        low, high = np.full((num_views, 2), np.inf), np.full((num_views, 2), -np.inf)
        np.minimum.at(low, view, crossing)
        np.maximum.at(high, view, crossing)
        seen = np.isfinite(low[:, 0])
        self.spacing, self.corner = spacing, np.where(seen[:, None], low - MARGIN * spacing, 0.0)
        size = np.ceil((high - low)[seen].max(axis=0) / spacing) + 2 * MARGIN
        self.shape = tuple(fft.next_fast_len(int(each), real=True) for each in size)
        self.num_views = num_views
        # Wave vectors (2, ...) and wave numbers [rad/m].
        turns = np.meshgrid(fft.fftfreq(self.shape[0]), fft.rfftfreq(self.shape[1]), indexing="ij")
        self.vector = 2.0 * np.pi / spacing * np.array(turns)
        self.number = np.hypot(*self.vector)
        # How many terms of the whole transform a term of the half stands for.
        self.times = np.full(self.number.shape, 2.0, dtype=np.float32)
        self.times[:, 0] = 1.0
        if self.shape[1] % 2 == 0:
            self.times[:, -1] = 1.0

    def matrix(self, d: Displacements) -> sparse.csr_matrix:
        """Displacements (2 M,) of coefficients (V * nodes,)."""
        at = (d.crossing - self.corner[d.view]) / self.spacing
        first = np.floor(at).astype(int)
        (x, slope_x), (y, slope_y) = (_spline(part) for part in (at - first).T)
        columns, rows = ((first[:, axis, None] + np.arange(-1, 3)) % self.shape[axis] for axis in (0, 1))
        node = (d.view[:, None, None] * self.shape[0] + columns[:, :, None]) * self.shape[1] + rows[:, None]
        of_surface = np.stack([slope_x[:, :, None] * y[:, None], x[:, :, None] * slope_y[:, None]]) / self.spacing
        value = np.einsum("mab,bmij->maij", d.by_gradient, of_surface)
        value += d.by_height[:, :, None, None] * (x[:, :, None] * y[:, None])[:, None]
        index = np.broadcast_to(node[:, None], value.shape).ravel()
        shape = 2 * len(at), self.num_views * self.shape[0] * self.shape[1]
        return sparse.csr_matrix((value.astype(np.float32).ravel(), index, 16 * np.arange(shape[0] + 1)), shape=shape)

    def coefficients(self, waves: np.ndarray) -> np.ndarray:
        """Coefficients (V, columns, rows) of Fourier transforms."""
        return fft.irfft2(waves, s=self.shape, norm="ortho").astype(np.float32)

    def transformed(self, coefficients: np.ndarray) -> np.ndarray:
        """Fourier transforms (V, ...) of coefficients."""
        return fft.rfft2(coefficients.reshape(-1, *self.shape), norm="ortho")

    def product(self, one: np.ndarray, other: np.ndarray) -> float:
        """Inner product of Fourier transforms."""
        return float(np.einsum("vij,vij,ij->", one.real, other.real, self.times)) + float(
            np.einsum("vij,vij,ij->", one.imag, other.imag, self.times)
        )

    def mean(self, spectrum: np.ndarray) -> float:
        """Mean over the whole Fourier transform."""
        return float((self.times * spectrum).sum()) / (self.shape[0] * self.shape[1])

    def smoothed(self, spectrum: np.ndarray) -> np.ndarray:
        """A spectrum smoothed over neighbouring wave vectors."""
        columns, half = np.arange(self.shape[0]), spectrum.shape[1]
        opposite = spectrum[-columns][:, self.shape[1] - np.arange(half, self.shape[1])]
        whole = np.concatenate([spectrum, opposite], axis=1)
        return ndimage.gaussian_filter(whole, SPECTRUM_STD, mode="wrap")[:, :half]


def _spline(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (M, 4) of four coefficients of a cubic B-spline at parts u (M,) of a spacing, and their derivatives."""
    v = 1.0 - u
    weights = v**3, 3.0 * u**3 - 6.0 * u**2 + 4.0, 3.0 * v**3 - 6.0 * v**2 + 4.0, u**3
    slopes = -(v**2), 3.0 * u**2 - 4.0 * u, 4.0 * v - 3.0 * v**2, u**2
    return np.stack(weights, axis=-1) / 6.0, np.stack(slopes, axis=-1) / 2.0


@dataclass(frozen=True)
class Sea:
    """The waves of a survey, by the power spectrum of their surfaces.

    Of wavelengths up to half of the shorter side of what a photograph shows: what is longer is a tilt or a bend of its
    water, which errors of its pose and lens are, too.
    """

    significant_height_m: float  # Four standard deviations of a surface
    slope_rms: float  # Root mean square of the steepest slope
    peak_length_m: float  # Wavelength of the largest power
    axis_deg: float  # Axis along which slopes are largest, clockwise from the second axis of the frame, 0 to 180

    @staticmethod
    def of(grid: SurfaceGrid, spectrum: np.ndarray) -> Sea:
        """Of a power spectrum (columns, half of the rows) of coefficients."""
        # Of the values of a B-spline, from its coefficients.
        power = spectrum * np.prod((2.0 + np.cos(grid.vector * grid.spacing)) / 3.0, axis=0) ** 2
        power = np.where(grid.number * grid.spacing * min(grid.shape) >= 4.0 * np.pi, power, 0.0)
        (xx, xy), (_, yy) = ([grid.mean(power * one * other) for other in grid.vector] for one in grid.vector)
        peak = grid.number.flat[int(np.argmax(power))]
        axis = np.degrees(0.5 * np.arctan2(2.0 * xy, yy - xx)) % 180.0
        height = 4.0 * np.sqrt(grid.mean(power))
        return Sea(float(height), float(np.sqrt(xx + yy)), float(2.0 * np.pi / peak), float(axis))


@dataclass(frozen=True)
class Posterior:
    """Surfaces of V photographs, and a random draw of how wrong they are."""

    grid: SurfaceGrid
    coefficients: np.ndarray  # (V, columns, rows) float32 [m]
    sea: Sea
    noise: float  # Variance of the displacements, over that by their information
    displacement: np.ndarray  # (M, 2) [m]: by the surfaces
    shifts: np.ndarray  # (2, M, 2) [m]: measured, less what is free: of still water, and of the surfaces
    # (draws, C, 3) [m]: height of a cell and shift of its photographs by the error of the surfaces, less `common_std`
    errors: np.ndarray
    common_std: float  # [m]: of the error of all heights alike, by a bend that all surfaces share
    # still_std, left_std [m]: of heights by waves, were the water taken as still, and by what is wrong with surfaces
    still_std: float
    left_std: float


def find_surfaces(d: Displacements, num_views: int, spacing: float, more_draws: int = MORE_DRAWS) -> Posterior:
    """Surfaces of photographs with coefficients at a spacing [m]; ``more_draws``: after those of the last steps."""
    grid, cells = SurfaceGrid(d.crossing, d.view, num_views, spacing), CellAdjustment(d.cell, d.parallax, d.information)
    system = System.of(d, grid, cells)
    random, measured = np.random.default_rng(0), d.measured.astype(np.float32)
    spectrum, noise = _start(d, grid, cells), 1.0
    waves = np.zeros((num_views, *spectrum.shape), dtype=np.complex64)
    drawn = []
    # The surfaces and a draw of their errors side by side; the numbers that are drawn are those of one thread.
    with ThreadPoolExecutor(2) as pool:
        for _ in range(ROUNDS):
            root = np.sqrt(spectrum).astype(np.float32)
            waves = np.divide(waves, root, out=np.zeros_like(waves), where=root > 0.0)
            system = replace(system, root=root, noise=noise)
            solution = pool.submit(system.solve, cells.weighted(measured), waves)
            error = system.error_of(*system.drawn(random))
            waves = solution.result()
            found, wrong = (system.displacement(each) for each in (waves, error))
            drawn.append(cells.free(cells.weighted(wrong)))
            squares = (part * cells.left(cells.weighted(part)) for part in (measured - found, wrong))
            noise = sum(float(each.sum(dtype=np.float64)) for each in squares) / cells.degrees_of_freedom
            ratio = grid.smoothed((np.square(np.abs(waves)) + np.square(np.abs(error))).mean(axis=0))
            spectrum, waves = spectrum * ratio**HASTE, waves * root
        draws = [pool.submit(system.error_of, *system.drawn(random)) for _ in range(more_draws)]
    more = (cells.free(cells.weighted(system.displacement(each.result()))) for each in draws)
    errors = np.array([*drawn[-DRAWS:], *more])
    common = errors[:, :, 0].mean(axis=1)
    errors[:, :, 0] -= common[:, None]
    std = float(np.sqrt(np.mean(common**2)))
    shifts = np.stack([each - cells.by_free(cells.weighted(each)) for each in (measured, measured - found)])
    # Of cells that few photographs show, at the rim, errors are many times those of the others.
    taken, left = (
        np.quantile(np.abs(each), _ONE_STD) for each in (cells.free(cells.weighted(found))[:, 0], errors[..., 0])
    )
    return Posterior(
        grid, grid.coefficients(waves), Sea.of(grid, spectrum), noise, found, shifts, errors, std,
        float(np.hypot(taken, left)), float(left),
    )  # fmt: skip


def _start(d: Displacements, grid: SurfaceGrid, cells: CellAdjustment) -> np.ndarray:
    """The first spectrum: with the mean square of the displacements."""
    falls = np.maximum(grid.number, 2.0 * np.pi / (START_LENGTH * grid.spacing)) ** START_SLOPE
    spectrum = np.where(grid.number > 0.0, falls, 0.0)
    measured = d.measured.astype(np.float32)
    square = float((measured * cells.left(cells.weighted(measured))).sum()) / float(d.size.sum())
    by_slope = np.square(d.by_gradient).sum(axis=(1, 2)).mean() / 2.0
    return spectrum * (square / by_slope / grid.mean(spectrum * grid.number**2))


@dataclass(frozen=True)
class System:
    """Normal equations of surfaces, as Fourier transforms of unit prior variance."""

    grid: SurfaceGrid
    cells: CellAdjustment
    factor: np.ndarray  # (M, 2, 2): of the information
    matrix: sparse.csr_matrix  # (2 M, nodes of all views): displacements of coefficients
    transposed: sparse.csc_matrix
    known: float  # Mean information of the gradient at a node
    root: np.ndarray | float = 0.0  # Of the spectrum
    noise: float = 1.0

    @staticmethod
    def of(d: Displacements, grid: SurfaceGrid, cells: CellAdjustment) -> System:
        """Without a prior."""
        matrix = grid.matrix(d)
        slack = (1e-6 * d.size + 1e-9)[:, None, None] * np.eye(2)
        factor = np.linalg.cholesky(d.information + slack).astype(np.float32)
        of_gradients = 0.5 * d.size * np.square(d.by_gradient).sum(axis=(1, 2))
        known = float(of_gradients.sum()) / matrix.shape[1]
        return System(grid, cells, factor, matrix, matrix.T, known)

    def displacement(self, waves: np.ndarray) -> np.ndarray:
        """Displacements (M, 2) by surfaces."""
        return (self.matrix @ self.grid.coefficients(waves * self.root).ravel()).reshape(-1, 2)

    def _gradient(self, weighted: np.ndarray) -> np.ndarray:
        """Adjoint of `displacement`, of weighted displacements (M, 2) without what is free."""
        found = self.transposed @ self.cells.left(weighted).ravel()
        return self.grid.transformed(found) * (self.root / np.float32(self.noise))

    def _normal(self, waves: np.ndarray) -> np.ndarray:
        """The normal matrix times surfaces."""
        return waves + self._gradient(self.cells.weighted(self.displacement(waves)))

    def solve(self, weighted: np.ndarray, waves: np.ndarray) -> np.ndarray:
        """Surfaces of weighted displacements (M, 2) by preconditioned conjugate gradients from a start."""
        product, right = self.grid.product, self._gradient(weighted)
        # About the diagonal of the normal matrix, were all nodes known alike.
        diagonal = 1.0 + (self.root * self.grid.number).astype(np.float32) ** 2 * np.float32(self.known / self.noise)
        residual = right - self._normal(waves)
        preconditioned = residual / diagonal
        direction, square = preconditioned, product(residual, preconditioned)
        enough = CG_RESIDUAL**2 * product(right, right / diagonal)
        for _ in range(CG_STEPS):
            if square <= enough:
                break
            turned = self._normal(direction)
            step = np.float32(square / product(direction, turned))
            waves, residual = waves + step * direction, residual - step * turned
            preconditioned = residual / diagonal
            before, square = square, product(residual, preconditioned)
            direction = preconditioned + np.float32(square / before) * direction
        return waves

    def drawn(self, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Random surfaces, and their weighted displacements (M, 2) with noise."""
        shape = self.grid.num_views, *self.grid.shape
        surfaces = self.grid.transformed(random.standard_normal(shape, dtype=np.float32))
        noise = np.einsum("mab,mb->ma", self.factor, random.standard_normal((len(self.factor), 2), dtype=np.float32))
        weighted = self.cells.weighted(self.displacement(surfaces)) + np.float32(np.sqrt(self.noise)) * noise
        return surfaces, weighted

    def error_of(self, surfaces: np.ndarray, weighted: np.ndarray) -> np.ndarray:
        """Error of the surfaces that are found from weighted displacements (M, 2) of drawn ones."""
        return self.solve(weighted, np.zeros_like(surfaces)) - surfaces
