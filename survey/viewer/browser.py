"""The server that a browser talks to (viser), of this machine alone unless another address is asked for."""

from __future__ import annotations

import asyncio
import io
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from survey.errors import SurveyError

if TYPE_CHECKING:
    import viser

_SKY, _SUN = 2.0, 1.4
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


def open_server(host: str, port: int, title: str) -> viser.ViserServer:
    """A server at an address of this machine; the next free port, where the one that is asked for is taken.

    Raises
    ------
    SurveyError
        If viser is not installed, or the address is not of this machine.
    """
    try:
        import viser
    except ModuleNotFoundError as error:
        raise SurveyError("a run is shown by viser, which is not installed: pip install 'bathynerf[viewer]'") from error
    try:
        # viser takes a refusal for a port that is taken and tries the next one.
        asyncio.run(_listen(host))
    except OSError as error:
        raise SurveyError(
            f"--host {host} is no address of this machine ({error.strerror or error}); give localhost, 0.0.0.0 for all "
            "of its addresses, or one of them"
        ) from error
    # viser says where it listens, which the command does itself.
    with redirect_stdout(io.StringIO()), _own_pages_only(host) as guarded:
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    if not guarded:
        server.stop()
        raise RuntimeError(f"viser {viser.__version__} serves in another way than the check of origins knows")
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    light(server)
    # A page in the browser could ask for a public address of the run.
    server.__dict__["request_share_url"] = lambda *_, **__: None
    return server


@contextmanager
def _own_pages_only(host: str) -> Iterator[list[Any]]:
    """While a server of viser starts, its connections are made to be refused to pages of other sites.

    A browser opens a WebSocket to this machine for any page; viser answers each, and has no hook for it. Yields the
    list of what was made so: empty where viser no longer serves by this function.
    """
    from websockets.asyncio import server as websockets

    serve, made = websockets.serve, []

    def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            if not is_own_page(request.headers, host):
                return connection.respond(403, "this page is not of the server\n")
            return process_request(connection, request)

        made.append(serve(*arguments, process_request=answer, **options))
        return made[-1]

    websockets.serve = guarded  # type: ignore[assignment, misc]
    try:
        yield made
    finally:
        websockets.serve = serve  # type: ignore[misc]


def is_own_page(headers: Mapping[str, str], host: str) -> bool:
    """Whether a request comes from a page of this server, or from no page; by its headers.

    A server of this machine alone answers to names of this machine alone, so that no other name can be led here.
    """
    named, origin = headers.get("Host") or "", headers.get("Origin")
    if host in _LOOPBACK and urlsplit(f"//{named}").hostname not in _LOOPBACK:
        return False
    return origin is None or urlsplit(origin).netloc == named


def light(server: viser.ViserServer) -> None:
    """Light from the north-west and from all around, so that surfaces have about their own colours, and relief."""
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(False)
    server.scene.add_light_ambient("/light/sky", intensity=_SKY)
    server.scene.add_light_directional("/light/sun", intensity=_SUN, position=(-1.0, 1.0, 1.2))


async def _listen(host: str) -> None:
    server = await asyncio.start_server(lambda _reader, _writer: None, host, 0)
    server.close()
    await server.wait_closed()


def close_server(server: viser.ViserServer) -> None:
    """End a server, without the word that viser has for it."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def address(server: viser.ViserServer, host: str) -> str:
    """Address to open in a browser on this machine."""
    name = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{name}:{server.get_port()}"
