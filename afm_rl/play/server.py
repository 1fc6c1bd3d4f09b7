"""viser's server for the browser of the user who started it: others are refused, values checked."""

from __future__ import annotations

import http
import math
from functools import partial
from typing import Any

import msgspec
import viser
import websockets.asyncio.server as serving
from websockets.http11 import Request, Response

from afm_rl.errors import ConfigurationError

NAMES = ("127.0.0.1", "localhost")


class Setting(msgspec.Struct):
    """The value of an input."""

    value: bool | int | float | str


class Update(msgspec.Struct, tag_field="type", tag="GuiUpdateMessage"):
    """The one message of viser's that a browser's are read as: an input has another value."""

    uuid: str
    updates: Setting


class Connection(serving.ServerConnection):
    """A connection to a browser; viser gets to see only what ``page`` has checked."""

    def __init__(self, page: LocalServer, *parts: Any, **settings: Any) -> None:
        super().__init__(*parts, **settings)
        self.page = page

    async def handshake(self, process_request: Any = None, *rest: Any, **settings: Any) -> None:
        """Let in requests to this page, from this page."""
        port = self.local_address[1]
        own = [f"{name}:{port}" for name in NAMES] + list(NAMES if port == 80 else ())
        policy = (
            "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; "
            f"connect-src 'self' data: blob: {' '.join(f'ws://{host}' for host in own)}; "
            "frame-ancestors 'none'"
        )

        def admit(connection: serving.ServerConnection, request: Request) -> Response | None:
            hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
            ours = len(hosts) == 1 and hosts[0] in own
            ours = ours and all(origin in [f"http://{host}" for host in own] for origin in origins)
            # Browsers always say which page opens a websocket; of files they need not.
            if not ours or ("Upgrade" in request.headers and not origins):
                return self.respond(http.HTTPStatus.FORBIDDEN, f"only from http://{own[0]}\n")
            response = process_request(connection, request)
            if response is not None:  # a link to the page could name another server
                response.headers["Content-Security-Policy"] = policy
            return response

        await super().handshake(admit, *rest, **settings)

    async def recv(self, decode: Any = None) -> bytes:  # type: ignore[override]
        """Return the next message that may be passed on."""
        while True:
            message = self.page.checked(await super().recv(decode=False))
            if message is not None:
                return message


class LocalServer(viser.ViserServer):
    """viser for browsers of this machine that show its own page.

    viser has no setting for it, so it is given another class of connections while it starts.

    Args:
        port: of 127.0.0.1.
        label: above the controls.

    Attributes:
        inputs: what browsers may change, by viser's name of it; filled where inputs are added.
        clicked: names of the buttons that were clicked; emptied by the code that acts on them.

    Raises:
        ConfigurationError: if this version of viser cannot be guarded.
    """

    def __init__(self, port: int, label: str) -> None:
        self.inputs: dict[str, Any] = {}
        self.clicked: set[str] = set()
        usual, guarded = serving.serve, []

        def serve(*parts: Any, **settings: Any) -> serving.serve:
            guarded.append(True)
            # Messages are of so many bytes at most; a browser's have a hundred.
            settings |= {"max_size": 2**16, "create_connection": partial(Connection, self)}
            return usual(*parts, **settings)

        serving.serve = serve  # type: ignore[assignment, misc]
        try:
            super().__init__(NAMES[0], port, label=label, verbose=False)
        finally:
            serving.serve = usual  # type: ignore[misc]
        if not guarded:
            self.stop()
            raise ConfigurationError(
                f"viser {viser.__version__} would serve every web page: pip install 'viser<1.2'"
            )

    def request_share_url(self, verbose: bool = True) -> None:
        """Return None: there is no tunnel."""

    def checked(self, message: bytes) -> bytes | None:
        """Return what viser may see of a browser's message: a value that an input can have."""
        try:
            update = msgspec.msgpack.decode(message, type=Update)
        except Exception:  # whatever it is, it is no update
            return None
        value = allowed(self.inputs.get(update.uuid), update.updates.value)
        if isinstance(self.inputs.get(update.uuid), viser.GuiButtonHandle):
            self.clicked.add(update.uuid)  # viser would queue one call for each
        return (
            None if value is None else msgspec.msgpack.encode(Update(update.uuid, Setting(value)))
        )


def allowed(handle: Any, value: bool | float | str) -> bool | float | str | None:
    """Return the value that an input gets if a browser asks for one; None if it keeps its own.

    A slider's is brought to its nearest mark; a choice is one of those offered.
    """
    if isinstance(handle, viser.GuiCheckboxHandle):
        return value if isinstance(value, bool) else None
    if isinstance(handle, viser.GuiDropdownHandle):
        return value if value in handle.options else None
    if not isinstance(handle, viser.GuiSliderHandle) or isinstance(value, bool | str):
        return None
    if not math.isfinite(value):
        return None
    steps = round((min(max(value, handle.min), handle.max) - handle.min) / handle.step)
    return round(handle.min + steps * handle.step, 9)
