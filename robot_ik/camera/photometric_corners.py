"""Marker corners from all of the print, in the picture's own grey values, whatever the camera did to them.

The borders between the black and white cells of a marker are as sharp as its sides, and there are many more
of them.  ``corner_refinement`` takes the place where grey is half way between black and white for an edge.
That is right for a camera whose grey values are proportional to light.  Webcams, telephones and JPEG files
have a tone curve; bloom and ink that bleeds do the same: the half way moves, mostly into the black, by a part
of the blur, and every marker looks smaller than it is.  Since the print has black cells in white and white
cells in black, it says by how much: the shift is one more unknown of the fit
(``print_equations`` has the model).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from robot_ik.camera.corner_refinement import RefinedCorners
from robot_ik.camera.detection import Image, correctable, to_gray
from robot_ik.camera.image import marker_bits
from robot_ik.camera.intrinsics import CameraIntrinsics
from robot_ik.camera.lens import CX, CY, FX, FY, lens_vector
from robot_ik.camera.print_equations import (
    ANY_NOISE,
    AT_REST,
    BLOCK,
    BLUR,
    CAUCHY,
    CONTRAST,
    CURVED,
    DARK,
    EVERY,
    FIT_NUMBERS,
    HALO,
    HALO_WIDTH,
    HALOED,
    HELD,
    HOMOGRAPHY,
    LEAST_LN_BLUR,
    LEAST_NOISE,
    MISS_ROWS,
    NOISE,
    PIXEL_ROWS,
    PLAIN,
    SHIFT,
    SPACE_ROWS,
    TO_DROP,
    UNKNOWNS,
    USED,
    see_points,
    settle,
    take_print,
)
from robot_ik.kernels.jit import announce

Array = NDArray[np.float64]

# Blur that sharpening subtracts, px: unsharp masks of webcams and telephones are narrow, those of programs
# wider.
_HALO_BLURS = (1.2, 2.0, 3.0)
# White round the black square that is looked at, in cells.
_ROUND = 0.45
# So many pixels say whether the model needs more unknowns.
_ASKED = 800
# Steps at most.
_STEPS = 14
# Pixels of a fit at least: twice the unknowns.
_LEAST_PIXELS = 2 * HALOED
# Blur of an edge, px, and what it is believed to be before it is measured, as ln.
_BLUR, _BLUR_SPREAD = 0.8, 0.6
# A corner may go so far from where it was found: px, part of the side.  The detector's sharp corners of a
# strongly tilted marker are off by a tenth; a print that is shifted by a cell explains nothing.
_FARTHEST, _FARTHEST_PART = 3.0, 0.2
#: Edge shift and its spread for a camera of which nothing is known: none for a linear one, 0.5 for sRGB.
UNKNOWN_SHIFT = (0.25, 0.35)
# Spread of the edge shift between the markers of a picture (light, printing).
_SHIFT_ALIKE = 0.08
# Least standard deviation of corners, px, and of the edge shift by side lines, as a part of it.
_LEAST_SIGMA, _SHIFT_PART = 0.01, 0.05
# Of a print that is believed: contrast in grey levels, and part of the variance that the model explains.
_LEAST_CONTRAST, _EXPLAINED = 5.0, 0.75
# Quadratic light and a halo are taken where they lessen the sum of squares by these parts: by chance it is a
# hundredth.  Mild sharpening (0.6) gives 0.01 to 0.04 and does no harm; strong (1.5) gives 0.06 to 0.13.
_LIGHT_ASKED, _HALO_ASKED = 0.03, 0.05
# Corners of the print as (u, v, 1), and (4, 2, 8) how u and v there follow the unknowns of the homography.
_CORNERS = np.array([[-0.5, -0.5, 1.0], [0.5, -0.5, 1.0], [0.5, 0.5, 1.0], [-0.5, 0.5, 1.0]])
_BY_UNKNOWN = np.array(
    [[[1, u, v, 0, 0, 0, u * u, u * v], [0, 0, 0, 1, u, v, u * v, v * v]] for u, v, _ in _CORNERS]
)
# Unknowns of a fit as it is, with light that is curved, with a halo.
_MODELS_ASKED = tuple(
    np.array([*range(PLAIN), *more]) for more in ((), range(CURVED, UNKNOWNS), range(HALO, HALOED))
)


@dataclass(frozen=True)
class EdgeShift:
    """How far edges seem to lie in the black, in sigmas of the blur: what a camera's tone curve does.

    Attributes:
        value: 0 for a camera whose grey values are proportional to light, about 0.5 for sRGB.
        sigma: Standard deviation.
    """

    value: float = UNKNOWN_SHIFT[0]
    sigma: float = UNKNOWN_SHIFT[1]

    @classmethod
    def of(cls, intrinsics: CameraIntrinsics) -> EdgeShift:
        """What is known of a camera beforehand: by its calibration, if that has measured it."""
        if intrinsics.edge_shift is None:
            return cls()
        return cls(intrinsics.edge_shift, max(intrinsics.edge_shift_sigma or 0.0, _SHIFT_ALIKE))


@dataclass(frozen=True)
class PrintEffort:
    """How many pixels a fit uses.

    Attributes:
        looked_at: Of a print, about.
        fitted: Of those near an edge, at most.
    """

    looked_at: int = 9000
    fitted: int = 2200


#: Of a picture alone: more pixels make no marker better than the model is; and in films, which want to be
#: fast: the next picture comes soon.
SINGLE, FILM = PrintEffort(), PrintEffort(2500, 1000)


class _PrintFit:
    """The fit of one print: its unknowns, and what is known of them.

    Attributes:
        x: (23,) unknowns; the homography is in ``to_print``.
        unknowns: How many the model has; ``halo`` how wide a halo is among them, px, 0 without.
        halo: See ``unknowns``.
        to_print: (9,) from (x, y, 1), undistorted, to (u, v, 1) over the depth.
        pixels: (8, k), of which ``count`` are used.
        count: See ``pixels``.
        numbers: Noise and so on, see NOISE.
        misses: (5, k) residuals and their places on the print.
    """

    def __init__(self, black: Array, to_print: Array, by_unknown: Array, pixels: Array, count: int) -> None:
        self.black, self.to_print, self.by_unknown = black, to_print.ravel(), by_unknown
        self.pixels, self.count = pixels, count
        self.x, self.trust, self.expected = np.zeros(UNKNOWNS), np.zeros(UNKNOWNS), np.zeros(UNKNOWNS)
        self.trust[BLUR] = 1.0 / _BLUR_SPREAD**2
        self.numbers, self.normal = np.zeros(FIT_NUMBERS), np.zeros((24, 24))
        self.space = np.zeros((SPACE_ROWS, BLOCK))
        self.misses = np.empty((MISS_ROWS, pixels.shape[1]))
        self.unknowns, self.halo = PLAIN, 0.0

    def believe(self, blur: float, shift: EdgeShift) -> None:
        """What is known beforehand."""
        self.expected[BLUR], self.expected[SHIFT] = math.log(blur), shift.value
        self.trust[SHIFT] = 1.0 / shift.sigma**2

    def model(self, unknowns: int, halo: float) -> None:
        """Which unknowns there are; how wide the halo is, px, 0 without."""
        self.unknowns, self.halo = unknowns, halo
        self.trust[HALO], self.numbers[HALO_WIDTH] = 0.0 if halo > 0.0 else HELD, halo

    def _sum(self, steps: int) -> None:
        settle(
            self.pixels, self.count, self.black, self.to_print, self.x, self.unknowns, self.trust,
            self.expected, self.by_unknown, self.numbers, self.normal, self.space, self.misses, steps,
        )  # fmt: skip

    @property
    def used(self) -> int:
        """How many pixels the residuals are of."""
        return int(self.numbers[USED])

    @property
    def noise(self) -> float:
        """Grey levels."""
        return float(self.numbers[NOISE])

    def resume(self, model: tuple[float, ...]) -> None:
        """Starts from where the fit of the last picture ended."""
        self.model(int(model[1]), model[2])
        self.numbers[NOISE], self.numbers[TO_DROP], self.x[BLUR:] = model[0], 1.0, model[3:]

    def light(self, blur: float, shift: float, most: int) -> bool:
        """Fits dark and contrast, which are linear, and keeps ``most`` of the pixels that tell something."""
        self.x[BLUR], self.x[SHIFT] = math.log(blur), shift
        self.numbers[NOISE], self.numbers[EVERY], self.numbers[TO_DROP] = 0.0, 1.0, 1.0
        self._sum(0)
        self.count, self.numbers[TO_DROP], self.numbers[NOISE] = self.used, 0.0, ANY_NOISE
        if self.count < _LEAST_PIXELS:
            return False
        matrix, right = self._system()
        self.x[DARK:PLAIN] = np.linalg.solve(matrix[DARK:, DARK:], right[DARK:])
        if self.count > most:
            self.pixels = np.take(self.pixels, np.arange(most) * self.count // most, axis=1)
            self.count = most
        return True

    def settle(self) -> bool:
        """Gauss and Newton's steps; whether they became small."""
        self.numbers[EVERY] = 1.0
        self._sum(_STEPS)
        self.count = self.used
        return self.used >= _LEAST_PIXELS and bool(self.numbers[AT_REST])

    def _system(self) -> tuple[Array, Array]:
        """The equations with what is known beforehand: (n, n) and (n,)."""
        n, x = self.unknowns, self.x[: self.unknowns]
        matrix = self.normal[:n, :n] + self.normal[:n, :n].T
        weight = self.noise**2 * self.trust[:n]
        right = self.normal[n, :n] + weight * (self.expected[:n] - x)
        if x[BLUR] <= LEAST_LN_BLUR and right[BLUR] < 0.0:
            weight[BLUR] = HELD
        diagonal = matrix.reshape(-1)[:: n + 1]
        diagonal *= 0.5 * (1.0 + 1e-10)
        diagonal += weight + 1e-12
        return matrix, right

    def ask_for_more(self) -> bool:
        """Whether the residuals ask for uneven light or for a halo, which are then part of the model."""
        self.numbers[EVERY] = (self.count + _ASKED - 1) // _ASKED
        most, width, curved = 0.0, 0.0, False
        for halo in _HALO_BLURS:
            self.model(UNKNOWNS, halo)
            self._sum(0)
            matrix, right = self._system()
            plain, by_light, by_halo = (
                float(right[some] @ np.linalg.solve(matrix[np.ix_(some, some)], right[some]))
                for some in _MODELS_ASKED
            )
            squares = self.squares()
            curved = by_light - plain > _LIGHT_ASKED * squares
            if by_halo - plain > max(most, _HALO_ASKED * squares):
                most, width = by_halo - plain, halo
            if width == 0.0:
                break  # where a narrow one lessens nothing a wide one does not either
        self.model(UNKNOWNS if curved else HALOED if width else PLAIN, width)
        return curved or width > 0.0

    def squares(self) -> float:
        """Sum of the squares of the residuals; what is far off counts as four standard deviations."""
        squares = self.misses[0, : self.used] ** 2
        return float(np.minimum(squares, (CAUCHY * self.noise) ** 2).sum())

    def explained(self, *, before: bool = False) -> float:
        """Part of the variance of the grey values that the model explains, or did ``before`` the steps."""
        value, weight = self.pixels[6:, : self.count : 1 if before else int(self.numbers[EVERY])]
        miss, total = self.misses[3 if before else 0, : len(value)], float(weight.sum())
        off = value - weight @ value / total
        spread = float((weight * off) @ off)
        # Where hardly anything is to be seen nothing is there.
        return 1.0 - float((weight * miss) @ miss) / spread if spread > _LEAST_CONTRAST * total else 0.0

    def cells(self) -> tuple[int, float]:
        """How many cells the picture shows otherwise; squares of cells' residuals over those of noise."""
        n, (miss, u, v) = len(self.black), self.misses[:3, : self.used]
        # With a row and a column of what is outside on each side.
        column, row = (
            np.minimum(np.maximum((n * w + 0.5 * n + 1.0), 0.0), n + 1.0).astype(int) for w in (u, v)
        )
        cell, inside = (n + 2) * row + column, (slice(1, -1), slice(1, -1))
        total = np.bincount(cell, miss, (n + 2) ** 2).reshape(n + 2, n + 2)[inside]
        count = np.bincount(cell, minlength=(n + 2) ** 2).reshape(n + 2, n + 2)[inside]
        misread = int(np.count_nonzero(np.abs(total) > 0.5 * abs(self.x[CONTRAST]) * count))
        seen = max(int(np.count_nonzero(count)), 1)
        return misread, float((total**2 / np.maximum(count, 1)).sum()) / (seen * self.noise**2)

    def conclude(
        self,
        lens: Array,
        origin: tuple[int, int],
        start: RefinedCorners,
        other: RefinedCorners | None,
    ) -> RefinedCorners | None:
        """The corners, if they can be believed.

        Args:
            lens: ``lens_vector`` of the part of the picture that begins at ``origin``.
            origin: See ``lens``.
            start: Where the fit began.
            other: What was found without a halo, or in the last picture.
        """
        explained, x, (misread, uneven) = self.explained(), self.x, self.cells()
        if not x[CONTRAST] > max(_LEAST_CONTRAST, 1.5 * self.noise) or explained < _EXPLAINED:
            return None
        back = np.asarray(np.linalg.inv(self.to_print.reshape(3, 3)), dtype=float)
        normalized, depth = _places(back, _CORNERS)
        if not depth.min() > 0.0:
            return None
        corners, by_normalized = np.empty((4, 2)), np.empty((4, 2, 2))
        see_points(lens, normalized, corners, by_normalized)
        corners += origin
        (ax, ay), (bx, by) = (corners[2] - corners[0]).tolist(), (corners[3] - corners[1]).tolist()
        far = float(np.abs(corners - start.corners).max())
        if not far < max(_FARTHEST, _FARTHEST_PART * math.sqrt(0.5 * abs(ax * by - ay * bx))):
            return None
        covariance, sigma = self._uncertainty(uneven, corners, _corner_slopes(back, by_normalized))
        edges = math.exp(x[BLUR]), float(x[SHIFT]), sigma
        if self.halo > 0.0 and other is not None:
            # With a halo the model's edges are others than those that four sides see.
            edges = other.blur, other.edge_shift, other.edge_shift_sigma
        return RefinedCorners(
            corners, normalized, covariance, math.sqrt(covariance.trace() / 8), True, blur=edges[0],
            edge_shift=edges[1], edge_shift_sigma=edges[2], explained=explained, misread=misread,
            by_print=True, model=(self.noise, self.unknowns, self.halo, *x[BLUR:].tolist()),
        )  # fmt: skip

    def _uncertainty(self, uneven: float, corners: Array, slopes: Array) -> tuple[Array, float]:
        """Covariance (8, 8) of the corners, px^2; standard deviation of the edge shift."""
        variance = self.squares() / (self.used - self.unknowns)
        # Residuals that are alike all over a cell are no noise but a shadow's hard edge, glare, dirt: usual
        # pictures give 0.4 to 5 times what noise leaves of a cell's mean, squared; hard shadows 7 to 36.
        variance = max(variance, LEAST_NOISE**2) * max(1.0, uneven - 1.0)
        inverse = variance * np.linalg.inv(self._system()[0])
        covariance = slopes @ inverse[:HOMOGRAPHY, :HOMOGRAPHY] @ slopes.T
        way = corners - corners.mean(axis=0)
        outward = (way / np.hypot(way[:, :1], way[:, 1:])).reshape(8)
        covariance += _LEAST_SIGMA**2 * (0.5 * np.eye(8) + np.outer(outward, outward))
        return covariance, math.sqrt(inverse[SHIFT, SHIFT])


def _homography(corners: Array) -> Array | None:
    """(3, 3) from the print to its corners (4, 2) (Heckbert, 1989); None where these are on one line."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = corners.tolist()
    ax, ay, bx, by = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    sx, sy, area = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3, (x1 - x2) * (y3 - y2) - (y1 - y2) * (x3 - x2)
    if not abs(area) > 0.0:
        return None
    g, h = (sx * by - bx * sy) / area, (ax * sy - sx * ay) / area
    a, b, d, e = x1 - x0 + g * x1, x3 - x0 + h * x3, y1 - y0 + g * y1, y3 - y0 + h * y3
    return np.array([[a, b, x0 + 0.5 * (a + b)], [d, e, y0 + 0.5 * (d + e)], [g, h, 1.0 + 0.5 * (g + h)]])


def _places(homography: Array, on_print: Array) -> tuple[Array, Array]:
    """Where places (n, 3) of the print, as (u, v, 1), are seen (n, 2), and their depth (n,)."""
    there = on_print @ homography.T
    return there[:, :2] / there[:, 2:], there[:, 2]


def _corner_slopes(homography: Array, lens: Array | None = None) -> Array:
    """(8, 8) how the corners move by the unknowns of the homography; times ``lens`` (4, 2, 2)."""
    corners, depth = _places(homography, _CORNERS)
    slopes = homography[:2, :2] - corners[:, :, None] * homography[2, :2]
    slopes /= -depth[:, None, None]
    if lens is not None:
        slopes = lens @ slopes
    return (slopes @ _BY_UNKNOWN).reshape(8, 8)


def _box(seen: Array, shape: tuple[int, ...], reach: float, most: int) -> tuple[Array, int] | None:
    """Whole pixels (x0, y0, x1, y1) round a print, and one in how many is looked at.

    Args:
        seen: (3, 3) from the print to pixels.
        shape: Of the picture.
        reach: Of the print, u and v to each side.
        most: About so many pixels are enough.

    Returns:
        None where the print is not in the picture.
    """
    (a, b, c), (d, e, f), (g, h, i) = seen.tolist()
    xs, ys, least = [], [], math.inf
    for u, v in ((-reach, -reach), (reach, -reach), (reach, reach), (-reach, reach)):
        depth = g * u + h * v + i
        least = min(least, depth)
        xs.append((a * u + b * v + c) / depth)
        ys.append((d * u + e * v + f) / depth)
    x0, y0, x1, y1 = min(xs), min(ys), max(xs), max(ys)
    height, width = shape
    if not (least > 0.0 and x1 > 0.0 and y1 > 0.0 and x0 < width - 1.0 and y0 < height - 1.0):
        return None
    area = 0.5 * abs((xs[2] - xs[0]) * (ys[3] - ys[1]) - (ys[2] - ys[0]) * (xs[3] - xs[1]))
    box = [
        max(math.floor(x0), 0),
        max(math.floor(y0), 0),
        min(math.ceil(x1) + 1, width),
        min(math.ceil(y1) + 1, height),
    ]
    share = area / most
    return np.array(box), max(int(share + 0.5), 1) if share < 2.5 else 2 * int(0.5 * share) + 1


def _begin(
    gray: Image,
    lens: Array,
    black: Array,
    corners: Array,
    normalized: Array,
    push: float,
    effort: PrintEffort,
) -> _PrintFit | None:
    """The pixels of a print whose sides lie ``push`` px outside of what was found; None where it is not."""
    back, seen = _homography(normalized), _homography(corners)
    if back is None or seen is None:
        return None
    reach = 0.5 + _ROUND / len(black)
    found = _box(seen, gray.shape, reach, effort.looked_at)
    if found is None:
        return None
    box, every = found
    try:
        to_print = np.asarray(np.linalg.inv(back), dtype=float)
    except np.linalg.LinAlgError:
        return None
    # At the middle (u, v) are 0, and the depth is back[2, 2].
    slopes = np.hypot(to_print[:2, 0] / lens[FX], to_print[:2, 1] / lens[FY]) * abs(back[2, 2])
    to_print[:2] /= (1.0 + 2.0 * push * slopes)[:, None]
    pixels = np.empty((PIXEL_ROWS, ((box[2] - box[0]) // every + 1) * (box[3] - box[1])))
    count = take_print(gray, lens, box, every, to_print.ravel(), reach, pixels)
    return _PrintFit(black, to_print, _corner_slopes(seen), pixels, count)


def refine_prints(
    image: Image,
    sides: Sequence[RefinedCorners],
    ids: Sequence[int],
    dictionary: str,
    intrinsics: CameraIntrinsics,
    *,
    origin: tuple[int, int] = (0, 0),
    expected: EdgeShift | None = None,
    effort: PrintEffort = SINGLE,
    before: Mapping[int, RefinedCorners] = MappingProxyType({}),
) -> list[RefinedCorners]:
    """Corners of several markers by all of their prints.

    Where a print cannot be fitted its side lines are moved outwards by the edge shift of the others, or by
    the expected one, and are as uncertain as that.

    Args:
        image: (h, w) or (h, w, 3) uint8; or a part of the picture that holds the markers.
        sides: Corners by ``refine_markers``, to start from.
        ids: Of the markers.
        dictionary: Of all of them.
        intrinsics: Of the whole picture.
        origin: Pixel (x, y) of the whole picture at which the part begins.
        expected: Edge shift of this camera; None: as its calibration says.
        effort: How many pixels of a print are used.
        before: Of the last picture, by id: a fit starts from what was found there.
    """
    if not len(sides):
        return []
    announce(settle, "the fit of the markers' prints")
    gray, expected = np.ascontiguousarray(to_gray(image)), expected or EdgeShift.of(intrinsics)
    lens = lens_vector(intrinsics).copy()
    lens[[CX, CY]] -= origin
    fits = []
    for i, start in zip(ids, sides, strict=True):
        black, last = marker_black(dictionary, i), before.get(i)
        one = _fitted(gray, lens, black, start, origin, expected, effort, last)
        if last is not None and not one.by_print:
            one = _fitted(gray, lens, black, start, origin, expected, effort, None)
        fits.append(one)
    allowed = correctable(dictionary, strict=True)
    fits = [replace(one, misread=max(0, one.misread - allowed)) if one.misread else one for one in fits]
    shift = _common_shift([one for one in fits if one.by_print], expected)
    return [
        one if one.by_print or not one.refined else moved_outwards(one, shift, intrinsics) for one in fits
    ]


def is_print(corners: RefinedCorners) -> bool:
    """Whether the picture shows the marker's print there, and not something with a like code."""
    return corners.misread == 0 and not corners.explained < _EXPLAINED


def _common_shift(fitted: Sequence[RefinedCorners], expected: EdgeShift) -> EdgeShift:
    """The edge shift of a picture from that of its prints."""
    values = [(expected.value, expected.sigma), *((f.edge_shift, f.edge_shift_sigma) for f in fitted)]
    weights = np.array([1.0 / (sigma**2 + _SHIFT_ALIKE**2) for _, sigma in values])
    mean = float(weights @ [value for value, _ in values] / weights.sum())
    return EdgeShift(mean, math.sqrt(1.0 / weights.sum() + (_SHIFT_ALIKE**2 if fitted else 0.0)))


def moved_outwards(sides: RefinedCorners, shift: EdgeShift, intrinsics: CameraIntrinsics) -> RefinedCorners:
    """Corners whose side lines lie where the edges are: outwards by the edge shift."""
    along = np.roll(sides.corners, -1, axis=0) - sides.corners
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    turn = np.sign(along[0, 0] * along[1, 1] - along[0, 1] * along[1, 0])
    normals = turn * np.stack([along[:, 1], -along[:, 0]], axis=1)
    both = np.stack([normals, np.roll(normals, 1, axis=0)], axis=1)
    by_push = np.linalg.solve(both, np.ones((4, 2, 1)))[..., 0]
    corners = sides.corners + shift.value * sides.blur * by_push
    far = sides.blur * math.hypot(shift.sigma, _SHIFT_PART * shift.value)
    wide = sides.covariance + (far**2 + _LEAST_SIGMA**2) * np.outer(by_push, by_push)
    return replace(
        sides, corners=corners, normalized=intrinsics.undistort(corners), covariance=wide,
        sigma=math.sqrt(wide.trace() / 8), edge_shift=shift.value, edge_shift_sigma=shift.sigma,
    )  # fmt: skip


@lru_cache(maxsize=256)
def marker_black(dictionary: str, marker_id: int) -> Array:
    """(n, n) cells of a marker with its border, 1 where they are black."""
    return np.ascontiguousarray(marker_bits(dictionary, marker_id) == 0, dtype=float)


def _fitted(
    gray: Image,
    lens: Array,
    black: Array,
    start: RefinedCorners,
    origin: tuple[int, int],
    expected: EdgeShift,
    effort: PrintEffort,
    before: RefinedCorners | None,
) -> RefinedCorners:
    """Corners by one print; where that fails those of the sides, with how much the print explains."""
    blur, push = (start.blur, start.blur * expected.value) if start.refined else (_BLUR, 0.0)
    if before is not None and start.refined:
        push = before.blur * before.edge_shift
    fit = _begin(gray, lens, black, start.corners - origin, start.normalized, push, effort)
    if fit is None:
        return replace(start, explained=math.nan, misread=0)
    fit.believe(blur, expected)
    if before is not None and before.model is not None:
        fit.resume(before.model)
    elif not fit.light(blur, expected.value, effort.fitted):
        return replace(start, explained=math.nan, misread=0)
    found = None
    for more in (False, True):
        if more and not fit.ask_for_more():
            break
        fine = fit.settle()
        if fine:
            found = fit.conclude(lens, origin, start, found or before) or found
        if not fine or before is not None:
            break
    if found is not None:
        return found
    if fit.used < _LEAST_PIXELS:
        return replace(start, explained=math.nan, misread=0)
    explained = max(fit.explained(before=True), fit.explained())
    return replace(start, explained=explained, misread=fit.cells()[0])
