"""What a camera makes of the light that falls on its sensor: from a proportional one to a webcam.

Light goes through bloom and blur of the lens, colour filter and noise of the sensor, demosaicing, a tone
curve, sharpening and JPEG, in that order.  No edge is modelled here: the light is a picture, and each step is
what cameras do to pictures.
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

# Sigma of the glow round bright objects, and of the blur that sharpening subtracts, px.
_BLOOM, _SHARP = 3.0, 1.0
# Direction in which a moving camera smears, rad, and points along the way.
_MOTION_WAY, _MOTION_POINTS = math.radians(30.0), 41
# Steps of a sensor of 16 bit.
_RAW = 65535


def _srgb(light: Array) -> Array:
    """IEC 61966-2-1: linear near black, then a power of 1 / 2.4."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def _s_curve(light: Array) -> Array:
    """sRGB with more contrast in the middle, as telephones have it."""
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
    """How a picture is spoiled.

    Attributes:
        blur: Standard deviation of the optical blur, px.
        noise: Standard deviation of the noise, grey levels.
        gradient: Light lost from one end of the picture to the other, 0 to 1.
        black, white: Ink and paper in full light, in 1/255 of the light that the sensor can take.
        tone: Name of the tone curve, of ``TONES``.
        exposure: Light is taken so many times; what is too much is white.
        bayer: The sensor sees one colour a pixel (RGGB), the others are interpolated.
        sharpening: Strength of the unsharp mask, 0.6 is mild, 1.5 strong.
        bloom: Part of the light that is scattered round about.
        jpeg: Quality, 0 to 100; None: not compressed.
        bleed: Ink reaches so far beyond the black cells, metres.
        motion: The picture is smeared over so many pixels.
        shadow: Light lost behind the edge of a shadow across what is looked at, 0 to 1.
        shadow_edge: How soft that edge is, px.

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
        """Light (h, w) or (h, w, 3) behind the lens: bloom, blur, motion."""
        if self.bloom > 0.0:
            light = cv2.addWeighted(
                light, 1.0 - self.bloom, cv2.GaussianBlur(light, (0, 0), _BLOOM), self.bloom, 0.0
            )
        if self.blur > 0.0:
            light = cv2.GaussianBlur(light, (0, 0), self.blur)
        if self.motion > 0.0:
            light = cv2.filter2D(light, -1, _smear(self.motion), borderType=cv2.BORDER_REFLECT)
        return light

    def developed(self, light: NDArray[Any], unit_noise: NDArray[Any] | None) -> Image:
        """The picture (as ``light``) uint8 of light behind the lens.

        Args:
            light: (h, w) or (h, w, 3), 255 is all that the sensor can take.
            unit_noise: Noise of sigma 1, as ``light``; None: none.
        """
        noise = 0.0 if unit_noise is None else self.noise
        if self.bayer:
            levels: NDArray[Any] = _toned(
                _demosaiced(light * self.exposure, unit_noise, noise, self.tone), self.tone
            )
        else:
            plain = self.tone == "linear" and self.exposure == 1.0
            levels = light if plain else _toned(_raw(light * self.exposure), self.tone)
            if noise > 0.0:
                levels = levels + noise * np.asarray(unit_noise)
        if self.sharpening > 0.0:
            soft = cv2.GaussianBlur(levels, (0, 0), _SHARP)
            levels = cv2.addWeighted(levels, 1.0 + self.sharpening, soft, -self.sharpening, 0.0)
        # By rounding, not by cutting: half a grey level of bias would shift every edge.
        picture = np.asarray(np.clip(np.rint(levels), 0, 255).astype(np.uint8))
        if self.jpeg is None:
            return picture
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg])
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), dtype=np.uint8)


#: Grey values in proportion to light: an industrial camera, or a raw file.
LINEAR = SensorModel()
#: What people have: sRGB, colour filter, some bloom, mild sharpening, JPEG.
WEBCAM = SensorModel(noise=2.0, tone="srgb", bayer=True, sharpening=0.6, bloom=0.05, jpeg=90)


@lru_cache(maxsize=8)
def _tone_table(tone: str) -> NDArray[np.float32]:
    """Grey levels of all values of a sensor of 16 bit."""
    return np.asarray(255.0 * TONES[tone](np.arange(_RAW + 1) / _RAW), dtype=np.float32)


@lru_cache(maxsize=8)
def _noise_table(tone: str) -> NDArray[np.float32]:
    """How much light makes one grey level, in steps of 16 bit: where a curve is steep, little."""
    slope = np.gradient(_tone_table(tone).astype(float))
    return np.asarray(1.0 / np.maximum(slope, 1e-4), dtype=np.float32)


def _raw(light: ArrayLike) -> NDArray[np.uint16]:
    """In steps of 16 bit."""
    return np.clip(np.rint(np.asarray(light) * (_RAW / 255.0)), 0, _RAW).astype(np.uint16)


def _toned(raw: NDArray[np.uint16], tone: str) -> NDArray[np.float32]:
    return _tone_table(tone)[raw]


def _demosaiced(
    light: NDArray[Any], unit_noise: NDArray[Any] | None, noise: float, tone: str
) -> NDArray[np.uint16]:
    """Each pixel sees one colour, with its noise, and takes the others from its neighbours."""
    mosaic = np.array(light if light.ndim == 2 else light[..., 1], dtype=np.float32)
    if light.ndim == 3:  # BGR: red at the upper left, blue at the lower right of each four
        mosaic[0::2, 0::2], mosaic[1::2, 1::2] = light[0::2, 0::2, 2], light[1::2, 1::2, 0]
    raw = _raw(mosaic)
    if unit_noise is not None and noise > 0.0:
        own = np.asarray(unit_noise if unit_noise.ndim == 2 else unit_noise[..., 0])
        noisy = raw + noise * own * _noise_table(tone)[raw]
        raw = np.clip(np.rint(noisy), 0, _RAW).astype(np.uint16)
    colours = cv2.demosaicing(raw, cv2.COLOR_BayerRGGB2BGR)
    if light.ndim == 3:
        return np.asarray(colours, dtype=np.uint16)
    return np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY), dtype=np.uint16)


def _smear(length: float) -> Array:
    """Kernel of a motion over so many pixels."""
    half = math.ceil(0.5 * length) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1))
    for t in np.linspace(-0.5 * length, 0.5 * length, _MOTION_POINTS):
        x, y = half + t * math.cos(_MOTION_WAY), half + t * math.sin(_MOTION_WAY)
        i, j = int(x), int(y)
        a, b = x - i, y - j
        kernel[j : j + 2, i : i + 2] += np.outer((1 - b, b), (1 - a, a))
    return np.asarray(kernel / kernel.sum())
