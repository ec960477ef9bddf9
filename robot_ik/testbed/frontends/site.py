"""The files of the page around viser's 3D view, served by the same port as viser."""

from __future__ import annotations

import functools
import gzip
import http
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import viser
from websockets.datastructures import Headers
from websockets.http11 import Response

CHANNEL = "/testbed/channel"
"""Path of the page's own WebSocket."""

_PREFIX = "/testbed/"
_FOLDER = Path(str(files("robot_ik.testbed.frontends") / "web"))
_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".png": "image/png",
}
_TAGS = (
    b'<link rel="stylesheet" href="/testbed/page.css">'
    b'<script type="module" src="/testbed/page.js"></script>'
)


def path_of(request: Any) -> str:
    """Return the path of a request without its query."""
    return urlsplit(request.path).path


def site_answer(request: Any) -> Response | None:
    """Return the response to a request for a file of the page, or None for other requests."""
    path = path_of(request)
    if request.headers.get("Upgrade"):
        return None
    if path in ("/", "/index.html"):
        zipped = "gzip" in request.headers.get("Accept-Encoding", "")
        return _response(_index(zipped), "text/html; charset=utf-8", zipped=zipped)
    if not path.startswith(_PREFIX):
        return None
    name = path.removeprefix(_PREFIX)
    kind = _TYPES.get(Path(name).suffix)
    if kind is None or name not in _names():
        return _missing()
    return _response((_FOLDER / name).read_bytes(), kind)


def has_thumbnail(robot: str) -> bool:
    """Return whether the page has a picture of a robot of the catalogue."""
    return f"thumbnails/{robot}.png" in _names()


@functools.cache
def _names() -> frozenset[str]:
    """Return the files that may be served. A request never becomes a path."""
    return frozenset(file.relative_to(_FOLDER).as_posix() for file in _FOLDER.rglob("*.*"))


@functools.cache
def _index(zipped: bool) -> bytes:
    """Return viser's page with the style sheet and the script of ours."""
    page = Path(viser.__file__).parent / "client" / "build" / "index.html"
    before, end, after = page.read_bytes().rpartition(b"</body>")
    content = before + _TAGS + end + after
    return gzip.compress(content) if zipped else content


def _response(body: bytes, kind: str, *, zipped: bool = False) -> Response:
    fields = {"Content-Type": kind, "Content-Length": str(len(body))}
    if zipped:
        fields["Content-Encoding"] = "gzip"
    return Response(http.HTTPStatus.OK.value, "OK", Headers(fields), body)


def _missing() -> Response:
    return Response(
        http.HTTPStatus.NOT_FOUND.value, "Not Found", Headers({"Content-Length": "0"}), b""
    )
