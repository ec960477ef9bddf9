"""Model of the sensor and the image processing of a camera, from a linear camera to a webcam.

The steps are bloom and blur of the lens, colour filter and noise of the sensor, demosaicing, a tone
curve, sharpening and JPEG, in this order. Each step changes the picture as a camera does. No edge
is modelled here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_ik.errors import CameraError, unknown_name_text
from robot_ik.ports import Array, Image

# Sigma of the glow round bright objects, px.
_BLOOM_SIGMA = 3.0
# Sigma of the blur that sharpening subtracts, px.
_SHARPENING_SIGMA = 1.0
# Direction in which a moving camera smears, rad.
_MOTION_ANGLE = math.radians(30.0)
# Points along the way of a moving camera.
_MOTION_POINTS = 41
# Largest value of a sensor with 16 bit.
_RAW = 65535
# Smallest slope of a tone curve, grey levels per step of 16 bit.
_SMALLEST_SLOPE = 1e-4


def _srgb(light: Array) -> Array:
    """Apply IEC 61966-2-1: linear near black, then a power of 1 / 2.4."""
    power = 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, 12.92 * light, power)


def _s_curve(light: Array) -> Array:
    """Apply sRGB with more contrast in the middle, as phones do."""
    e = _srgb(light)
    return 0.5 * e + 0.5 * e * e * (3.0 - 2.0 * e)


#: Grey value (0 to 1) of light (0 to 1), by name.
TONES: dict[str, Callable[[Array], Array]] = {
    "linear": lambda light: light,
    "gamma 1.5": lambda light: light ** (1 / 1.5),
    "gamma 2.2": lambda light: light ** (1 / 2.2),
    "srgb": _srgb,
    "s-curve": _s_curve,
}


@dataclass(frozen=True)
class SensorModel:
    """Parameters of lens, sensor and image processing.

    Attributes:
        blur: Standard deviation of the optical blur, px.
        noise: Standard deviation of the noise, grey levels.
        gradient: Light lost from one end of the picture to the other, 0 to 1.
        black: Ink in full light, in 1/255 of the light that the sensor can take.
        white: Paper in full light, in the same unit.
        tone: Name of the tone curve, of ``TONES``.
        exposure: Factor of the light. Light beyond the range of the sensor is white.
        bayer: Whether the sensor measures one colour per pixel (RGGB) and interpolates the others.
        sharpening: Strength of the unsharp mask: 0.6 is mild, 1.5 strong.
        bloom: Part of the light that the lens scatters.
        jpeg: Quality, 0 to 100. None: not compressed.
        bleed: Ink beyond the black cells, metres.
        motion: Length over which the picture is smeared, px.
        shadow: Light lost behind the edge of a shadow across the object, 0 to 1.
        shadow_edge: Softness of that edge, px.

    Raises:
        CameraError: Unknown tone curve.
    """

    blur: float = 0.7
    noise: float = 4.0
    gradient: float = 0.5
    black: float = 25.0
    white: float = 225.0
    tone: str = "linear"
    exposure: float = 1.0
    bayer: bool = False
    sharpening: float = 0.0
    bloom: float = 0.0
    jpeg: int | None = None
    bleed: float = 0.0
    motion: float = 0.0
    shadow: float = 0.0
    shadow_edge: float = 20.0

    def __post_init__(self) -> None:
        if self.tone not in TONES:
            raise CameraError(unknown_name_text("tone curve", self.tone, list(TONES)))

    def scattered(self, light: NDArray[Any]) -> NDArray[Any]:
        """Return light (h, w) or (h, w, 3) behind the lens: with bloom, blur and motion."""
        if self.bloom > 0.0:
            glow = cv2.GaussianBlur(light, (0, 0), _BLOOM_SIGMA)
            light = cv2.addWeighted(light, 1.0 - self.bloom, glow, self.bloom, 0.0)
        if self.blur > 0.0:
            light = cv2.GaussianBlur(light, (0, 0), self.blur)
        if self.motion > 0.0:
            kernel = _motion_kernel(self.motion)
            light = cv2.filter2D(light, -1, kernel, borderType=cv2.BORDER_REFLECT)
        return light

    def developed(self, light: NDArray[Any], unit_noise: NDArray[Any] | None) -> Image:
        """Return the picture uint8 of light behind the lens.

        Args:
            light: (h, w) or (h, w, 3). 255 is the largest light that the sensor can take.
            unit_noise: Noise of sigma 1, in the shape of ``light``. None: no noise.
        """
        noise = 0.0 if unit_noise is None else self.noise
        if self.bayer:
            raw = _demosaiced(light * self.exposure, unit_noise, noise, self.tone)
            levels: NDArray[Any] = _toned(raw, self.tone)
        else:
            plain = self.tone == "linear" and self.exposure == 1.0
            levels = light if plain else _toned(_raw(light * self.exposure), self.tone)
            if noise > 0.0:
                levels = levels + noise * np.asarray(unit_noise)
        if self.sharpening > 0.0:
            soft = cv2.GaussianBlur(levels, (0, 0), _SHARPENING_SIGMA)
            levels = cv2.addWeighted(levels, 1.0 + self.sharpening, soft, -self.sharpening, 0.0)
        # Values are rounded, not truncated: half a grey level of bias would shift every edge.
        picture = np.asarray(np.clip(np.rint(levels), 0, 255).astype(np.uint8))
        if self.jpeg is None:
            return picture
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg])
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), dtype=np.uint8)


#: Grey values in proportion to light: an industrial camera, or a raw file.
LINEAR = SensorModel()
#: A usual camera: sRGB, colour filter, some bloom, mild sharpening, JPEG.
WEBCAM = SensorModel(noise=2.0, tone="srgb", bayer=True, sharpening=0.6, bloom=0.05, jpeg=90)


@lru_cache(maxsize=8)
def _tone_table(tone: str) -> NDArray[np.float32]:
    """Return the grey levels of all values of a sensor with 16 bit."""
    return np.asarray(255.0 * TONES[tone](np.arange(_RAW + 1) / _RAW), dtype=np.float32)


@lru_cache(maxsize=8)
def _noise_table(tone: str) -> NDArray[np.float32]:
    """Return the light of one grey level, in steps of 16 bit, at all values of the sensor."""
    slope = np.gradient(_tone_table(tone).astype(float))
    return np.asarray(1.0 / np.maximum(slope, _SMALLEST_SLOPE), dtype=np.float32)


def _raw(light: ArrayLike) -> NDArray[np.uint16]:
    """Return light (255 is the largest) in steps of 16 bit."""
    return np.clip(np.rint(np.asarray(light) * (_RAW / 255.0)), 0, _RAW).astype(np.uint16)


def _toned(raw: NDArray[np.uint16], tone: str) -> NDArray[np.float32]:
    """Return grey levels of values of the sensor."""
    return _tone_table(tone)[raw]


def _demosaiced(
    light: NDArray[Any], unit_noise: NDArray[Any] | None, noise: float, tone: str
) -> NDArray[np.uint16]:
    """Return the picture of a sensor with a colour filter.

    Each pixel measures one colour, with noise, and gets the others from its neighbours.
    """
    mosaic = np.array(light if light.ndim == 2 else light[..., 1], dtype=np.float32)
    if light.ndim == 3:
        # BGR: red is at the upper left, blue at the lower right of each four pixels.
        mosaic[0::2, 0::2] = light[0::2, 0::2, 2]
        mosaic[1::2, 1::2] = light[1::2, 1::2, 0]
    raw = _raw(mosaic)
    if unit_noise is not None and noise > 0.0:
        pixel_noise = np.asarray(unit_noise if unit_noise.ndim == 2 else unit_noise[..., 0])
        noisy = raw + noise * pixel_noise * _noise_table(tone)[raw]
        raw = np.clip(np.rint(noisy), 0, _RAW).astype(np.uint16)
    colours = cv2.demosaicing(raw, cv2.COLOR_BayerRGGB2BGR)
    if light.ndim == 3:
        return np.asarray(colours, dtype=np.uint16)
    return np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY), dtype=np.uint16)


def _motion_kernel(length: float) -> Array:
    """Return the kernel of a motion over a length in pixels."""
    half = math.ceil(0.5 * length) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    for t in np.linspace(-0.5 * length, 0.5 * length, _MOTION_POINTS):
        x = half + t * math.cos(_MOTION_ANGLE)
        y = half + t * math.sin(_MOTION_ANGLE)
        i = int(x)
        j = int(y)
        a = x - i
        b = y - j
        kernel[j : j + 2, i : i + 2] += np.outer((1 - b, b), (1 - a, a))
    return np.asarray(kernel / kernel.sum())
