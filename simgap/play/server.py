"""A web server for one browser on this machine: a page, and a socket for the hand and the blocks.

Sixty times a second the physics advances by the elapsed milliseconds and the new frame is sent. The server
listens on the loopback interface only, and only one page of its own origin may open the socket.
"""

import asyncio
import base64
import contextlib
import hashlib
import json
import time
from http import HTTPStatus
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from hmmseg.errors import InputError
from simgap.play.session import Session
from simgap.play.world import effect_values, felt_effects

HOST = "127.0.0.1"
FRAME = 1 / 60  # look: s
BEHIND = 50  # look: ms; most that one frame advances: a slower machine plays in slow motion
LONGEST_MESSAGE = 4096  # limit: bytes


def _digest_of(page: bytes, kind: str) -> str:
    """Hash of the page's only inline script or style, as a content security policy states it."""
    inside = page.partition(f"<{kind}>".encode())[2].partition(f"</{kind}>".encode())[0]
    return f"'sha256-{base64.b64encode(hashlib.sha256(inside).digest()).decode()}'"


class PlayServer:
    """Serves a session; `output` is the folder for the trials that the page saves."""

    def __init__(self, session: Session, output: Path) -> None:
        self.session, self.output = session, output
        self.busy = False
        self.saved: list[Path] = []
        self._server: Server | None = None

    async def start(self, port: int = 0) -> str:
        """Listen on a port of this machine (0: any free one); the page's address."""
        page = files("simgap.play").joinpath("page.html").read_bytes()
        sockets: list[str] = []
        inline = {kind: _digest_of(page, kind) for kind in ("script", "style")}

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            hosts = [host.rpartition(":")[0] for host in request.headers.get_all("Host")]
            if hosts not in ([HOST], ["localhost"]):
                return connection.respond(HTTPStatus.FORBIDDEN, "only this machine\n")
            if request.path == "/socket":
                origins = request.headers.get_all("Origin")
                if len(origins) == 1 and origins[0] in self.origins:
                    return None
                return connection.respond(HTTPStatus.FORBIDDEN, "only the page's own origin\n")
            if request.path != "/":
                return connection.respond(HTTPStatus.NOT_FOUND, "the page is at /\n")
            headers = Headers({"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(page)),
                               "Connection": "close", "X-Content-Type-Options": "nosniff",
                               "Content-Security-Policy": (
                                   f"default-src 'none'; script-src {inline['script']}; "
                                   f"style-src {inline['style']}; connect-src {' '.join(sockets)}; "
                                   "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
                               )})  # fmt: skip
            return Response(200, "OK", headers, page)

        self._server = await serve(self._play, HOST, port, process_request=answer, max_size=LONGEST_MESSAGE,
                                   compression=None)  # fmt: skip
        port = next(iter(self._server.sockets)).getsockname()[1]
        self.origins = (f"http://{HOST}:{port}", f"http://localhost:{port}")
        sockets += [origin.replace("http", "ws", 1) for origin in self.origins]
        return f"http://{HOST}:{port}/"

    async def stop(self) -> None:
        """Close the socket and stop listening."""
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    async def _play(self, connection: ServerConnection) -> None:
        if self.busy:
            await connection.close(4001, "somebody plays already")
            return
        self.busy = True
        try:
            await connection.send(json.dumps(self._scene()))
            drawing = asyncio.create_task(self._draw(connection))
            try:
                async for message in connection:
                    answer = await self._handled(message)
                    if answer is not None:
                        await connection.send(json.dumps(answer))
            finally:
                drawing.cancel()
                with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                    await drawing
        except ConnectionClosed:
            pass
        finally:
            self.busy = False

    def _scene(self) -> dict[str, Any]:
        return self.session.scene() | {"offered": sorted(felt_effects())}

    async def _draw(self, connection: ServerConnection) -> None:
        last, due = time.monotonic(), 0.0
        while True:
            now = time.monotonic()
            due = min(due + 1e3 * (now - last), BEHIND)
            last = now
            steps = int(due)
            due -= steps
            self.session.advance(steps)
            await connection.send(json.dumps(self.session.frame()))
            await asyncio.sleep(max(FRAME - (time.monotonic() - now), 0.001))

    async def _handled(self, message: str | bytes) -> dict[str, Any] | None:
        """Act on a message of the page; a malformed one changes nothing and is answered with an error."""
        try:
            request = json.loads(message)
            kind = request["kind"]
            if kind == "aim":
                grip = float(request.get("grip", 3.0))
                self.session.aim(float(request["x"]), float(request["y"]), request["closed"] is True, grip)
            elif kind == "touch":
                self.session.touch(np.array(request["tips"], float))
            elif kind == "reset":
                self.session.reset()
            elif kind == "effect":
                return await self._change(request["name"])
            elif kind == "save":
                return self._save()
            else:
                raise ValueError(kind)
        except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
            return {"kind": "said", "text": "unreadable message"}
        return None

    async def _change(self, name: str | None) -> dict[str, Any]:
        """Switch an effect of the second world on (or off: None)."""
        if name is not None and (not isinstance(name, str) or name not in felt_effects()):
            return {"kind": "said", "text": "no such effect"}
        world = None
        if name is not None:  # compiled while the page keeps running
            world = await asyncio.to_thread(self.session.world_with, {name: effect_values(name)})
        self.session.compare_with(world)
        return self._scene()

    def _save(self) -> dict[str, Any]:
        try:
            written = self.session.save(self.output)
        except (OSError, ValueError, InputError) as error:
            return {"kind": "said", "text": str(error)}
        self.saved.append(written[-1])
        return {"kind": "saved", "file": str(written[-1])}
