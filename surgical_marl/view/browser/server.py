"""Start the viewer's web server: on this machine alone, with a secret token in the path of its address.

viser serves its page and a websocket on one port, by the public package websockets, to everybody who can reach it.
Here it gets a socket that is bound to 127.0.0.1, and websockets asks `_guarded` before it answers any request, be it
for the page or for the websocket: the path has to begin with the secret. Other users of this machine, and pages of
other sites in the same browser, do not know it. viser's page opens its websocket under its own address, secret
included.

viser takes no socket and no such question as arguments. So `websockets.asyncio.server.serve`, which viser calls when it
starts, is replaced while it starts. If a later viser does not call it, there is an error and no server.
"""

from __future__ import annotations

import contextlib
import hmac
import importlib.util
import inspect
import io
import secrets
import socket
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from viser import ViserServer

HOST = "127.0.0.1"


def check_viser() -> None:
    """Raise ValueError if viser is not installed."""
    if importlib.util.find_spec("viser") is None:
        raise ValueError("the viewer needs the package viser: pip install 'surgical-marl[view]'")


def open_server(port: int) -> tuple[ViserServer, str]:
    """Start viser on a port, 0 for any that is free, and return its server and the address of the page.

    Raises:
        ValueError: viser is not installed, or the port is taken.
    """
    check_viser()
    import viser

    token = secrets.token_urlsafe(24)
    listener = _bind(port)
    try:
        # viser writes a table with an address that lacks the token.
        with _guarded(token, listener) as used, contextlib.redirect_stdout(io.StringIO()):
            server = viser.ViserServer(host=HOST, verbose=False)
        if not used:
            close_server(server)
            raise RuntimeError(
                "this version of viser starts its server in another way: no page is served without a guard"
            )
    except BaseException:
        listener.close()
        raise
    return server, f"http://{HOST}:{listener.getsockname()[1]}/{token}/"


def check_port(port: int) -> None:
    """Raise ValueError if a port is taken."""
    _bind(port).close()


def close_server(server: ViserServer) -> None:
    """Stop a server of viser, without a word."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _bind(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port that was just left can be used again
    try:
        listener.bind((HOST, port))
        listener.listen()
    except OSError as error:
        listener.close()
        raise ValueError(f"cannot serve on port {port}: {error.strerror}; name another one with --port, or 0") from None
    return listener


@contextlib.contextmanager
def _guarded(token: str, listener: socket.socket) -> Iterator[list[bool]]:
    """Let servers of websockets that start meanwhile use this socket, and answer only requests with the token."""
    import websockets.asyncio.server as module

    serve, used = module.serve, []

    def serve_guarded(handler: Any, _host: Any, _port: Any, *, process_request: Any, **options: Any) -> Any:
        used.append(True)

        async def ask(connection: Any, request: Any) -> Any:
            path = unlocked(request.path, token)
            if path is None:
                return connection.respond(403, "The address lacks its secret: use the one that the terminal shows.\n")
            request.path = path
            answer = process_request(connection, request)
            return await answer if inspect.isawaitable(answer) else answer

        return serve(handler, sock=listener, process_request=ask, **options)

    vars(module)["serve"] = serve_guarded  # mypy takes `serve` for a type, which can't be assigned
    try:
        yield used
    finally:
        vars(module)["serve"] = serve


def unlocked(path: str, token: str) -> str | None:
    """Return the path of a request without the token that it begins with; None if it begins otherwise."""
    given, _, rest = path.partition("?")[0].removeprefix("/").partition("/")
    return f"/{rest}" if hmac.compare_digest(given.encode(errors="surrogateescape"), token.encode()) else None
