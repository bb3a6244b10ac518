"""Who may speak with the server: whoever knows the token, from the server's own page.

The token is the first part of every path, so each address on the page carries it without a word:
``http://127.0.0.1:8000/TOKEN/page/app.js``. Beyond that the Host must be this machine under a name
that no foreign name server can give out, and where a browser says which page asks (Origin), it
must be ours.
"""

import hmac
import ipaddress
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from misstep.errors import MisstepError

Scope = dict[str, Any]
Receive = Callable[[], Awaitable[dict[str, Any]]]
Send = Callable[[dict[str, Any]], Awaitable[None]]
App = Callable[[Any, Any, Any], Awaitable[None]]

HEADERS = (
    (b"cache-control", b"no-store"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
)


class Guard:
    """An ASGI application around another one, which sees only what may pass.

    Parameters
    ----------
    app : ASGI application
        Sees paths without the token.
    token : str
    policy : str
        The content security policy of every answer.
    """

    def __init__(self, app: App, token: str, policy: str) -> None:
        self._app = app
        self._prefix = f"/{token}".encode()
        self._headers = [*HEADERS, (b"content-security-policy", policy.encode("ascii"))]
        self.failure: MisstepError | None = None
        """Why the application could not start, or not end as it should."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request or a socket pass, or refuse it in one sentence."""
        if scope["type"] == "lifespan":
            await self._live(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal is not None:
            await self._refuse(scope, receive, send, refusal)
            return
        prefix = self._prefix.decode()
        inner = {**scope, "path": scope["path"][len(prefix) :], "root_path": ""}

        async def send_with_headers(message: dict[str, Any]) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message["headers"], *self._headers]}
            await send(message)

        await self._app(inner, receive, send_with_headers)

    async def _live(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self._app(scope, receive, send)
        except MisstepError as error:
            self.failure = error
            raise

    def _refusal(self, scope: Scope) -> str | None:
        headers = {name.lower(): value for name, value in scope["headers"]}
        host = headers.get(b"host", b"").decode("latin-1")
        if not is_local_name(host):
            return "this server answers only under its own address: open the one that it printed"
        path = scope["path"].encode("utf-8", "replace")
        start = path[: len(self._prefix)]
        known = hmac.compare_digest(start, self._prefix)
        if not known or path[len(self._prefix) : len(self._prefix) + 1] != b"/":
            return "the address lacks the right token: open the one that `misstep live` printed"
        return _foreign(scope, headers, host)

    async def _refuse(self, scope: Scope, receive: Receive, send: Send, reason: str) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": "refused"})
            return
        body = f"misstep live: {reason}\n".encode()
        headers = [
            (b"content-type", b"text/plain; charset=utf-8"),
            (b"content-length", str(len(body)).encode()),
            *self._headers,
        ]
        await send({"type": "http.response.start", "status": 403, "headers": headers})
        await send({"type": "http.response.body", "body": body})


def is_local_name(host: str) -> bool:
    """Return whether a Host is a numeric address or ``localhost``, with or without a port.

    A page of somewhere else can have its own name lead to this machine, but it cannot have a
    number or ``localhost`` be its name.
    """
    name = host.rpartition(":")[0] if ":" in host and not host.endswith("]") else host
    if name == "localhost":
        return True
    try:
        ipaddress.ip_address(name.strip("[]"))
    except ValueError:
        return False
    return True


def _foreign(scope: Scope, headers: Mapping[bytes, bytes], host: str) -> str | None:
    """Return why a request is refused that comes from a page of somewhere else."""
    origin = headers.get(b"origin")
    if origin is None:
        # Browsers name the origin of every socket and of every request that changes something.
        return "a socket has to say where it comes from" if scope["type"] == "websocket" else None
    if origin.decode("latin-1") != f"http://{host}":
        return "another page has asked: only the server's own page may"
    return None
