"""The server of the live page: one page, one socket, a few files in and out.

It listens on this machine alone unless told otherwise. Nothing that comes from a page reaches the
file system as a name: attempts go by numbers, runs are looked up in a list, and of an uploaded
file only the suffix is taken, if a format knows it.
"""

import asyncio
import base64
import contextlib
import hashlib
import json
import logging
import re
import secrets
import socket
import tempfile
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import uvicorn
from fastapi import FastAPI, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import HTMLResponse, JSONResponse, PlainTextResponse

from misstep.errors import MisstepError
from misstep.live import downloads
from misstep.live.guard import Guard
from misstep.live.protocol import LONGEST_MESSAGE, Allowance, NotOursError, parse
from misstep.live.replay import MODULES, PAGE, import_map, page_html, replay_html
from misstep.live.session import Session, attempt_json
from misstep.storage import as_file_name, make_folder, write_text
from misstep.version import __version__

_TOKEN_FILE = "token"  # noqa: S105 - a file's name
_TOKEN = re.compile(r"[A-Za-z0-9_-]{22,64}", re.ASCII)
_OURS = 10
"""Messages of one page that are not ours, after which it is not listened to any more."""
_MOST_WAITING = 400
"""Messages to a page that does not read them, after which it is given up."""
_LAST_WORD = 2.0  # s, to say why a page is given up
_MIME = {".js": "text/javascript", ".css": "text/css"}


def open_socket(host: str, port: int) -> socket.socket:
    """Return a socket that listens on an address; port 0 takes any that is free.

    Raises
    ------
    MisstepError
        If that is not possible.
    """
    try:
        # Not reused while another server listens; at once after one has ended.
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=64)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MisstepError(
            f"cannot listen on {host}:{port}: {reason}; choose another --port, or 0 for any"
        ) from error


def stored_token(folder: Path) -> str:
    """Return the folder's token; a server that starts again answers the page that is open.

    Raises
    ------
    MisstepError
        If the folder cannot be made or written to.
    """
    make_folder(folder)
    path = folder / _TOKEN_FILE
    with contextlib.suppress(OSError, UnicodeDecodeError):
        token = path.read_text(encoding="ascii").strip()
        if _TOKEN.fullmatch(token):
            return token
    token = secrets.token_urlsafe(18)
    write_text(path, token + "\n")
    path.chmod(0o600)
    return token


class Page:
    """A page at the other end of a socket: what it is sent waits here until it has gone out."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._news: deque[str] = deque()
        self._frame: str | None = None
        self._something = asyncio.Event()
        self._too_many = asyncio.Event()

    def news(self, message: str) -> None:
        """Send a message; none is left out, but too many that wait end the connection."""
        if len(self._news) >= _MOST_WAITING:
            self._too_many.set()
            return
        self._news.append(message)
        self._something.set()

    def frame(self, message: str) -> None:
        """Send a state, in place of one that has not been sent yet."""
        self._frame = message
        self._something.set()

    async def send_all(self) -> str:
        """Send what is to be sent until the socket closes; return why the page is given up."""
        sending = asyncio.ensure_future(self._send())
        waiting = asyncio.ensure_future(self._too_many.wait())
        try:
            await asyncio.wait((sending, waiting), return_when=asyncio.FIRST_COMPLETED)
            return "this page does not read what it is sent" if waiting.done() else ""
        finally:
            sending.cancel()
            waiting.cancel()

    async def _send(self) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # RuntimeError: it is closed
            while True:
                await self._something.wait()
                self._something.clear()
                while self._news:
                    await self._socket.send_text(self._news.popleft())
                if self._frame is not None:
                    frame, self._frame = self._frame, None
                    await self._socket.send_text(frame)


def make_app(folder: Path, system: str, parameters: Mapping[str, Any], token: str) -> Guard:
    """Return the application.

    Parameters
    ----------
    folder : Path
        Everything that is recorded goes there.
    system : str
    parameters : mapping
        Of the system.
    token : str
        Without it nothing is answered.
    """
    imports = import_map({name: f"./page/{name}" for name in MODULES})
    style = '<link rel="stylesheet" href="./page/style.css">'
    start = '<script type="module" src="./page/app.js"></script>'
    html = page_html(imports, style, start, "null")
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None, lifespan=_lifespan)
    app.state.begin = lambda: Session(folder, system, parameters)
    app.state.html = html
    app.exception_handler(MisstepError)(_tell_error)
    _add_page(app)
    _add_files(app)
    app.websocket("/socket")(_talk)
    return Guard(app, token, _policy(imports))


def serve(app: Guard, listening: socket.socket, started: Callable[[], None]) -> None:
    """Serve until a Ctrl-C or a SIGTERM.

    Parameters
    ----------
    app : Guard
    listening : socket
    started : callable
        Called once it answers.

    Raises
    ------
    MisstepError
        If what was recorded before cannot be read.
    """
    config = uvicorn.Config(
        app,
        log_level="error",
        access_log=False,
        ws="websockets-sansio",
        ws_max_size=4 * LONGEST_MESSAGE,
        ws_ping_interval=10.0,
        ws_ping_timeout=10.0,
        timeout_graceful_shutdown=2,
        server_header=False,
        limit_concurrency=64,
    )
    # A page that leaves in mid-answer is nothing to tell of.
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
    server = _Server(config, started)
    try:
        server.run(sockets=[listening])
    finally:
        if app.failure is not None:  # of which uvicorn says nothing
            raise app.failure


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, started: Callable[[], None]) -> None:
        super().__init__(config)
        self._tell_started = started

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        if self.started:
            self._tell_started()


@contextlib.asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    session = app.state.session = app.state.begin()
    life = asyncio.create_task(session.live())
    try:
        yield
    finally:
        session.close()
        life.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await life


def _policy(imports: str) -> str:
    """Return the content security policy: everything from here, and the one inline script."""
    digest = base64.b64encode(hashlib.sha256(imports.encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'self' 'sha256-{digest}'; style-src 'self' "
        "'unsafe-inline'; img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'none'"
    )


def _tell_error(request: Request, error: Exception) -> Response:
    return JSONResponse({"problem": str(error)}, status_code=400)


def _add_page(app: FastAPI) -> None:
    names = {*MODULES, "style.css"}

    @app.get("/")
    async def page() -> Response:
        return HTMLResponse(app.state.html)

    @app.get("/page/{name}")
    async def part(name: str) -> Response:
        if name not in names:
            return PlainTextResponse("there is no such file\n", status_code=404)
        content = PAGE.joinpath(name).read_bytes()
        return Response(content, media_type=_MIME[Path(name).suffix])


def _add_files(app: FastAPI) -> None:
    def session() -> Session:
        current: Session = app.state.session
        return current

    @app.get("/api/formats")
    async def formats() -> Response:
        return JSONResponse({"version": __version__, "formats": downloads.show_formats()})

    @app.get("/api/attempt/{id}")
    async def attempt(id: int) -> Response:
        trajectory = session().attempts[id]
        return _json(await asyncio.to_thread(attempt_json, id, trajectory))

    @app.get("/api/run/{key}/demonstrations")
    async def demonstrations(key: int) -> Response:
        return _json(session().lesson.demonstrations or "[]")

    @app.get("/api/run/{key}/{number}")
    async def trial(key: int, number: int) -> Response:
        run, trials = session().lesson.run, session().lesson.trials
        if run is None or run["key"] != key or not 1 <= number <= len(trials):
            raise MisstepError("that trial is not there any more")
        return _json(trials[number - 1])

    @app.get("/api/download/{format_name}")
    async def download(format_name: str, id: int | None = None) -> Response:
        now = session()
        chosen = list(now.attempts.dataset) if id is None else [now.attempts[id]]
        stem = as_file_name(now.name) + ("-attempts" if id is None else "-attempt")
        async with downloads.written(now.worker, chosen, format_name) as path:
            return await _attached(path, stem + path.suffix)

    @app.get("/api/download-run/{name}")
    async def download_run(name: str) -> Response:
        folder = session().lesson.run_folder(name)
        async with downloads.packed(session().worker, folder) as path:
            return await _attached(path, f"{name}.zip")

    @app.get("/api/replay")
    async def replay() -> Response:
        told, recordings, trials = session().replay()
        html = await asyncio.to_thread(lambda: replay_html(told, recordings(), trials))
        return HTMLResponse(html, headers=_attachment("misstep-replay.html"))

    @app.put("/api/upload")
    async def upload(request: Request, name: str) -> Response:
        suffix = downloads.upload_suffix(name)
        with tempfile.TemporaryDirectory(prefix="misstep-") as folder:
            path = Path(folder) / f"upload{suffix}"
            await _receive(request, path)
            # Where it lies for the moment is nobody's business.
            try:
                count = await session().take_in(path)
            except MisstepError as error:
                said = str(error).replace(str(path), "it").replace(str(path.with_suffix("")), "it")
                raise MisstepError(said) from error
        return JSONResponse({"added": count})


async def _receive(request: Request, path: Path) -> None:
    """Write what is uploaded to a file, as long as it is not too much."""
    received = 0
    with path.open("wb") as file:
        async for chunk in request.stream():
            received += len(chunk)
            if received > downloads.MOST_UPLOADED:
                raise MisstepError(
                    f"the file is larger than {downloads.MOST_UPLOADED // 2**20} MB: cut it, or "
                    "use `misstep convert` and `misstep learn` on the command line"
                )
            file.write(chunk)
    if received == 0:
        raise MisstepError("the file is empty")


async def _attached(path: Path, name: str) -> Response:
    content = await asyncio.to_thread(path.read_bytes)
    return Response(content, media_type="application/octet-stream", headers=_attachment(name))


def _attachment(name: str) -> dict[str, str]:
    return {"content-disposition": f"attachment; filename*=utf-8''{quote(name)}"}


def _json(text: str) -> Response:
    return Response(text, media_type="application/json")


async def _talk(socket: WebSocket) -> None:
    """Hear what a page says, and tell it what happens, until it goes."""
    session: Session = socket.app.state.session
    await socket.accept()
    page = Page(socket)
    session.join(page)
    both = [
        asyncio.create_task(_hear(socket, session, page)),
        asyncio.create_task(page.send_all()),
    ]
    try:
        done, _ = await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        reason = next((task.result() for task in done if task.result()), "")
        if reason:
            with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):  # it is gone
                await asyncio.wait_for(socket.close(1008, reason), _LAST_WORD)
    finally:
        session.leave(page)
        for task in both:
            task.cancel()


async def _hear(socket: WebSocket, session: Session, page: Page) -> str:
    """Do what a page asks for; return why it is not listened to any more, empty if it has gone."""
    allowance, foreign = Allowance(), 0
    while True:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return ""
        if not allowance.take():
            return "this page sent far too many messages"
        try:
            session.do(page, parse(message.get("text") or message.get("bytes") or ""))
        except NotOursError as error:
            foreign += 1
            page.news(json.dumps({"t": "problem", "text": f"a message was refused: {error}"}))
            if foreign > _OURS:
                return "this page sent messages that are not ours"
        except MisstepError as error:
            page.news(json.dumps({"t": "problem", "text": str(error)}))


def address(host: str, port: int, token: str) -> str:
    """Return the address of the page, as a browser on this machine takes it."""
    everywhere = ("0.0.0.0", "::", "localhost")  # noqa: S104 - compared with, not bound to
    shown = "127.0.0.1" if host in everywhere else host
    bracketed = f"[{shown}]" if ":" in shown else shown
    return f"http://{bracketed}:{port}/{token}/"
