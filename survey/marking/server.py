"""The page of `bathynerf mark` and its data, served to a browser on the same machine or at the end of a tunnel.

Requests need a token: the page takes it from the address that the command prints, and sends it in a header, which pages
of other origins cannot.
"""

import json
import secrets
import sys
import threading
from collections.abc import Callable, Mapping
from email.message import Message
from functools import cache, lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from urllib.parse import parse_qs, quote, unquote, urlsplit

import cv2
import numpy as np

from geo.errors import GeoError
from survey.errors import ImageError, SurveyError
from survey.files.foreign_text import finite_numbers
from survey.marking.mark_store import PointKey
from survey.marking.masks import draw, packed
from survey.marking.proposals import corner
from survey.marking.session import MarkingSession
from survey.photos.images import eight_bits
from survey.photos.pixels import read_rgb
from survey.words import LARGEST, printable

TOKEN_HEADER = "X-Bathynerf-Token"
_LONGEST_REQUEST = 100_000
_CHANGES = ("/mark", "/add", "/undo", "/mask")
_SAFE = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "connect-src 'self'; img-src 'self' blob: data:",
}
TILE_PX = 512
_QUALITY = 92
# Decoded photographs that are kept, those that were read last: 45 megapixels take 180 MB.
_KEPT = 4


class PhotographTiles:
    """Image tiles of photographs, with a cache of decoded ones; thread-safe. Pixel x of level k begins at 2^k x."""

    def __init__(self, images: Mapping[str, Path]):
        self._images, self._decoding = images, threading.Lock()
        self._levels = lru_cache(_KEPT)(lambda image: pyramid(eight_bits(read_rgb(images[image]))))

    def jpeg(self, image: str, level: int, column: int, row: int) -> bytes:
        """A tile of at most `TILE_PX` pixels along each side."""
        if image not in self._images:
            raise ImageError(f"there is no photograph {image}")
        # A page asks for many tiles of a photograph at once.
        with self._decoding:
            levels = self._levels(image)
        left, top = column * TILE_PX, row * TILE_PX
        is_there = 0 <= level < len(levels) and left >= 0 and top >= 0
        part = levels[level][top : top + TILE_PX, left : left + TILE_PX] if is_there else np.zeros((0, 0, 3))
        if not part.size:
            raise ImageError(f"{image} has no tile {column}, {row} at level {level}")
        _, packed = cv2.imencode(".jpg", cv2.cvtColor(part, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        return packed.tobytes()


def pyramid(pixels: np.ndarray) -> list[np.ndarray]:
    """Image pyramid of a photograph (height, width, 3) uint8, halved down to the size of a tile."""
    levels = [pixels]
    while max(levels[-1].shape[:2]) > TILE_PX:
        height, width = levels[-1].shape[:2]
        even = cv2.copyMakeBorder(levels[-1], 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        levels.append(cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA))
    return levels


_Answer = tuple[HTTPStatus, str, bytes]


class MarkingServer(ThreadingHTTPServer):
    """HTTP server of a session, at any free port for port 0; its url has the token.

    Before `show` there is the page, which waits for what it shows.
    """

    daemon_threads = True
    session: MarkingSession
    tiles: PhotographTiles

    def __init__(self, session: MarkingSession | None = None, host: str = "localhost", port: int = 0):
        self.is_loaded = threading.Event()
        if session is not None:
            self.show(session)
        self.token = secrets.token_urlsafe(16)
        self.lock = threading.Lock()
        self.host = host
        super().__init__((host, port), _Handler)
        # 0.0.0.0 stands for every address of this machine, and cannot be opened.
        name = "localhost" if host == "0.0.0.0" else host
        self.url = f"http://{name}:{self.server_address[1]}/?token={quote(self.token)}"

    def show(self, session: MarkingSession) -> None:
        """Show a session, which has been loaded."""
        self.session, self.tiles = session, PhotographTiles(session.images)
        self.is_loaded.set()

    def handle_error(self, request, client_address):
        """As the library, but ignore browsers that close the connection early."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: MarkingServer
    protocol_version = "HTTP/1.1"

    def do_GET(self):
        """Answer with the page, the state, a point in a photograph, or a tile."""
        self._answer(self._got)

    def do_POST(self):
        """Set, move or remove a mark, add a point, or undo; answer with the new state."""
        self._answer(self._posted)

    def _answer(self, answer: Callable[[], _Answer]) -> None:
        """Send an answer; a request that cannot be understood or done gets a sentence."""
        try:
            status, kind, content = answer()
        except ConnectionError:
            raise
        except (SurveyError, GeoError) as error:
            status, kind, content = _sentence(HTTPStatus.UNPROCESSABLE_ENTITY, str(error))
        except OSError as error:
            status, kind, content = _sentence(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            status, kind, content = _sentence(HTTPStatus.BAD_REQUEST, f"not understood: {error}")
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(content)), **_SAFE}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def _got(self) -> _Answer:
        url = urlsplit(self.path)
        asked = {name: values[0] for name, values in parse_qs(url.query).items()}
        if not self._is_ours(asked.get("token", "") if url.path == "/" else None):
            return _FORBIDDEN
        if url.path == "/":
            return HTTPStatus.OK, "text/html; charset=utf-8", page()
        self.server.is_loaded.wait()
        if url.path == "/state":
            return self._json(lambda session: session.state())
        if url.path == "/look":
            return self._json(lambda session: session.look(_key(asked), asked["image"]))
        if url.path == "/propose":
            proposed = self.server.session.propose(_key(asked), self.server.lock)
            return self._json(lambda _session: proposed)
        if url.path.startswith("/mask/"):
            return HTTPStatus.OK, "image/png", packed(self.server.session.found, unquote(url.path[6:]))
        if url.path.startswith("/tile/"):
            level, column, row, image = url.path.removeprefix("/tile/").split("/", 3)
            tile = self.server.tiles.jpeg(unquote(image), int(level), int(column), int(row))
            return HTTPStatus.OK, "image/jpeg", tile
        return _NOT_FOUND

    def _posted(self) -> _Answer:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and int(length) <= _LONGEST_REQUEST):
            self.close_connection = True
            return _sentence(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "too long")
        body = self.rfile.read(int(length))
        if not self._is_ours():
            return _FORBIDDEN
        self.server.is_loaded.wait()
        path = urlsplit(self.path).path
        return self._json(lambda session: _changed(session, path, body)) if path in _CHANGES else _NOT_FOUND

    def log_message(self, format, *args):
        """Nothing: the console is that of the command."""

    def _json(self, answer) -> _Answer:
        with self.server.lock:
            return HTTPStatus.OK, "application/json", json.dumps(answer(self.server.session), allow_nan=False).encode()

    def _is_ours(self, token: str | None = None) -> bool:
        """Whether a request has the token, in its header unless it is given, and comes from this page."""
        given = self.headers.get(TOKEN_HEADER, "") if token is None else token
        return is_own_page(self.headers, self.server.host, given, self.server.token)


def _sentence(status: HTTPStatus, text: str) -> _Answer:
    return status, "text/plain; charset=utf-8", printable(text).encode()


_FORBIDDEN = _sentence(HTTPStatus.FORBIDDEN, "open the address that bathynerf mark printed")
_NOT_FOUND = _sentence(HTTPStatus.NOT_FOUND, "there is no such page")


def _key(request: dict) -> PointKey:
    return PointKey(str(request["kind"]), str(request["name"]))


def _changed(session: MarkingSession, path: str, body: bytes) -> dict:
    """The state after one of `_CHANGES`."""
    request, undone = json.loads(body), {}
    if not isinstance(request, dict):
        raise ValueError("expected an object in JSON")
    if path == "/undo":
        edit = session.store.undo()
        undone = {"undone": {"kind": edit.key.kind, "name": edit.key.name, "image": edit.image}}
    elif path == "/add":
        place = request.get("place")
        session.store.add(*_key(request), None if place is None else _numbers(place, 3))
    elif path == "/mask":
        corners = np.array([_numbers(corner, 2) for corner in request["corners"]])
        draw(session.found, str(request["image"]), corners, is_used=bool(request["is_used"]))
    else:
        pixel, image = None if request["pixel"] is None else _numbers(request["pixel"], 2), str(request["image"])
        if pixel is not None and request.get("corner"):
            pixel = corner(session.grey(image), pixel)
        session.store.set(_key(request), image, pixel)
    return session.state() | undone


def _numbers(values, count: int) -> tuple:
    numbers = finite_numbers(values, count)
    if numbers is None:
        raise ValueError(f"expected {count} numbers of at most {LARGEST:g}")
    return tuple(numbers)


@cache
def page() -> bytes:
    """The page with its style and script in it."""
    room = files("survey.marking")
    parts = {name: room.joinpath(f"page.{name}").read_text(encoding="utf-8") for name in ("html", "css", "js")}
    text = parts["html"].replace("/* page.css */", parts["css"]).replace("/* page.js */", parts["js"])
    return text.replace("{tile_px}", str(TILE_PX)).encode()


_LOOPBACK = ("localhost", "127.0.0.1", "::1")


def is_own_page(headers: Mapping[str, str] | Message, host: str, given: str, token: str) -> bool:
    """Whether a request to a server at a host has its token, and comes from a page of it, or from no page.

    A server on a loopback address only answers requests to loopback names, against DNS rebinding.
    """
    named, origin = headers.get("Host") or "", headers.get("Origin")
    is_here = host not in _LOOPBACK or urlsplit(f"//{named}").hostname in _LOOPBACK
    is_own = origin is None or origin in (f"http://{named}", f"https://{named}")
    return secrets.compare_digest(given.encode(), token.encode()) and is_here and is_own
