"""Who may see the page, and what can be sent to it: nothing else has an effect."""

import socket
import threading
from types import SimpleNamespace

import pytest
from harness import until

from afm_rl.errors import ConfigurationError
from afm_rl.play import World, make_robot

viser = pytest.importorskip("viser")
msgspec = pytest.importorskip("msgspec")

from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import connect  # noqa: E402

from afm_rl.play import server as guarded  # noqa: E402
from afm_rl.play.page import Page  # noqa: E402

HANDSHAKE = "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
HANDSHAKE += "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
HANDSHAKE += f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n"
NAN = float("nan")


@pytest.fixture(scope="module")
def page():
    """A page that runs, of a robot with two actuators."""
    page = Page(World(make_robot("ugv")), "ugv", 0)
    page.thread = threading.Thread(target=page.run)
    page.thread.start()
    yield page
    page.end()
    page.thread.join()


@pytest.fixture
def browser(page):
    """A websocket of the page itself, all of whose messages have been read at ``settle``."""
    own = f"http://127.0.0.1:{page.server.get_port()}"
    how = {"max_queue": None, "ping_interval": None, "origin": own}
    version = [f"viser-v{viser.__version__}"]
    with connect(own.replace("http", "ws"), subprotocols=version, **how) as browser:

        def settle():
            before = page.world.direction
            browser.send(changed(page.buttons[0][0], True))
            until(lambda: page.world.direction != before)  # the running page has pushed both

        browser.settle = settle
        yield browser
    assert page.thread.is_alive()


def message(kind, **fields):
    return msgspec.msgpack.encode({"type": kind, **fields})


def changed(handle, value):
    return message("GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": value})


def answer(port, headers):
    """Return the head of the answer to a request."""
    with socket.create_connection(("127.0.0.1", port)) as stream:
        stream.sendall(f"GET / HTTP/1.1\r\n{headers}\r\n".encode())
        return b"".join(iter(stream.makefile("rb").readline, b"\r\n")).decode()


@pytest.mark.parametrize("upgrade", ["", "websocket", "WebSocket"])
@pytest.mark.parametrize(
    ("hosts", "origins", "page_itself"),
    [
        (["127.0.0.1:PORT"], ["http://127.0.0.1:PORT"], True),
        (["localhost:PORT"], ["http://localhost:PORT"], True),
        (["127.0.0.1:PORT"], [], None),  # a file, but no websocket: browsers name its origin
        (["127.0.0.1:PORT"], ["http://evil.example"], False),
        (["127.0.0.1:PORT"], ["http://127.0.0.1:PORT.evil.example"], False),
        (["127.0.0.1:PORT"], ["https://127.0.0.1:PORT"], False),
        (["127.0.0.1:PORT"], ["http://127.0.0.1:1"], False),
        (["127.0.0.1:PORT"], ["null"], False),
        (["127.0.0.1:PORT"], ["http://127.0.0.1:PORT", "http://evil.example"], False),
        (["evil.example:PORT"], ["http://127.0.0.1:PORT"], False),  # a name bound again
        (["evil.example:PORT"], ["http://evil.example:PORT"], False),
        (["evil.example:PORT"], [], False),
        (["127.0.0.1:1"], [], False),
        (["127.0.0.1:PORT", "evil.example"], [], False),
        ([], [], False),
    ],
)
def test_only_the_page_itself_is_served(hosts, origins, page_itself, upgrade, page):
    port = page.server.get_port()
    headers = [f"Host: {host}" for host in hosts] + [f"Origin: {origin}" for origin in origins]
    text = "".join(f"{header}\r\n" for header in headers).replace("PORT", str(port))
    text += f"Upgrade: {upgrade}\r\n{HANDSHAKE}" if upgrade else ""
    served = page_itself or (page_itself is None and not upgrade)
    head = answer(port, text)
    assert head.split()[1] in (("101", "200") if served else ("403",))
    assert "200 OK" not in head or "frame-ancestors 'none'" in head


@pytest.mark.parametrize(
    ("name", "value", "becomes"),
    [
        ("speed", 0, 0.1),
        ("speed", 1.04, 1.0),
        ("pause", 1, None),
        ("choice", "all of them", None),
        ("choice", "late 4", "late 4"),
        ("shown", "", None),
        ("shown", "turn", "turn"),
        ("gain_0", NAN, None),
        ("gain_0", 1e30, 1.5),
        ("gain_1", -0.74, -0.7),
        ("gain_1", True, None),
        ("gain_1", [1.0], None),
        ("delay", 2.6, 3.0),
        ("delay", 2**64 - 1, 10.0),
        ("bias_0", "0.1", None),
    ],
)
def test_values_are_checked(name, value, becomes, page, browser):
    handle = page.sliders[name][0] if name in page.sliders else getattr(page, name)
    before = handle.value
    browser.send(changed(handle, value))
    browser.settle()
    assert handle.value == (before if becomes is None else becomes)
    assert type(handle.value) is type(before)
    if name in page.sliders:
        assert page.world.fault[name] == handle.value


def test_nothing_else_has_an_effect(page, browser, monkeypatch):
    tunnels = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *_: tunnels.append(1))
    monkeypatch.setattr(threading, "excepthook", lambda failed: tunnels.append(failed))
    handle = page.sliders["gain_0"][0]
    before = {name: dict(vars(x._impl)) for name, x in page.server.inputs.items()}
    uuid, kinds = handle._impl.uuid, viser._messages.Message.get_subclasses()
    assert len(kinds) > 100
    for kind in kinds:
        fields = {name: uuid for name in getattr(kind, "__dataclass_fields__", ())}
        browser.send(message(kind.__name__, **fields))
        browser.send(message(kind.__name__))
    for name in (*vars(handle._impl), "nothing"):
        if name != "value":
            updates = {name: True}
            browser.send(message("GuiUpdateMessage", uuid=uuid, updates=updates))
            browser.send(message("GuiUpdateMessage", uuid=uuid, updates=updates | {"value": NAN}))
    broken = changed(handle, -1.0)
    for part in range(len(broken)):
        browser.send(broken[:part])
        browser.send(broken[:part] + b"\xc1" + broken[part + 1 :])
    browser.send(b"\x91" * 60_000)  # lists of lists of ...
    browser.send(b"\x82\xa1x" + b"\x91" * 60_000)
    browser.send(message("GuiUpdateMessage", uuid="nobody", updates={"value": 1.0}))
    browser.send(message("GuiUpdateMessage", uuid=[uuid], updates={"value": 1.0}))
    browser.send(message("GuiUpdateMessage", uuid=uuid, updates=[1.0]))
    browser.send('{"type": "ShareUrlRequest"}')
    for handlers in page.server._websock_server._incoming_handlers.items():
        if handlers[0].__name__ == "ShareUrlRequest":  # viser's own way to a tunnel, if it has one
            handlers[1][0](0, None)
    browser.settle()
    for name, state in before.items():  # a damaged message may name a number that can be set
        now = vars(page.server.inputs[name]._impl)
        differing = {key for key in state if state[key] is not now[key] and state[key] != now[key]}
        assert differing <= {"value", "update_timestamp"} and set(now) == set(state)
        if differing:
            assert guarded.allowed(page.server.inputs[name], now["value"]) == now["value"]
    assert page.server.request_share_url() is None and not tunnels


def test_a_flood_ends_nothing(page, browser):
    reset, before = page.buttons[1][0], page.world.seed
    for _ in range(2000):
        browser.send(changed(reset, True))
    browser.settle()
    assert before < page.world.seed < before + 1000  # once a picture at most
    with pytest.raises(ConnectionClosed):
        browser.send(message("GuiUpdateMessage", uuid="x" * 10**6, updates={"value": 1}))
        while True:
            browser.recv(timeout=30)


def test_a_viser_that_serves_in_another_way_is_refused(monkeypatch):
    monkeypatch.setattr(guarded, "serving", SimpleNamespace(serve=None))
    with pytest.raises(ConfigurationError, match="would serve every web page: pip install"):
        guarded.LocalServer(0, "unguarded")
