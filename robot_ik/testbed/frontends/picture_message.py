"""A camera's picture as one binary message of the channel."""

from __future__ import annotations

import math
import struct

import cv2

from robot_ik.ports import Image

JPEG_QUALITY = 82

HEADER = struct.Struct("<IdHHfff")
"""Before each JPEG: number of the picture, time (s, Unix clock), width and height, and pixel (u, v)
and radius of the ball that the mouse can take, NaN without one."""

NO_BALL = (math.nan, math.nan, math.nan)


def packed(
    image: Image, number: int, taken: float, ball: tuple[float, float, float] = NO_BALL
) -> bytes:
    """Return a picture (h, w, 3) BGR as header and JPEG.

    Args:
        image: The picture.
        number: Its number.
        taken: When the camera took it, seconds of the Unix clock.
        ball: Pixel (u, v) and radius of the ball.
    """
    height, width = image.shape[:2]
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return HEADER.pack(number, taken, width, height, *ball) + data.tobytes()
