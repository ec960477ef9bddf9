"""Where pictures come from: photographs, folders, films, cameras, network streams.

``frames`` opens a source from one text and defines what a ``Frame`` and a ``FrameSource`` are; ``device``
is a camera with its thread, ``device_list`` tells which cameras there are without opening one (and without
OpenCV), ``picture_files`` reads and writes pictures.  Pictures that are computed come from ``made_up``.
"""

from typing import TYPE_CHECKING

from robot_ik.camera.on_demand import on_demand

if TYPE_CHECKING:
    from robot_ik.camera.sources.frames import (
        ClosingSource,
        FolderSource,
        Frame,
        FrameSource,
        ImageSource,
        VideoSource,
        open_source,
    )

__all__ = [
    "ClosingSource",
    "FolderSource",
    "Frame",
    "FrameSource",
    "ImageSource",
    "VideoSource",
    "open_source",
]

__getattr__ = on_demand(
    __name__,
    {
        "frames": (
            "ClosingSource",
            "FolderSource",
            "Frame",
            "FrameSource",
            "ImageSource",
            "VideoSource",
            "open_source",
        ),
    },
)
