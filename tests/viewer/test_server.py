from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
import time
from http.client import HTTPConnection
from itertools import pairwise

import numpy as np
import pytest
import viser
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from viewer_client import Client
from viser import _messages
from websockets.exceptions import InvalidStatus

from marl_handover.errors import InvalidSetting
from marl_handover.viewer import server as guard
from marl_handover.viewer.server import PortTaken, address, keep_updating, open_server


def test_the_page_is_for_this_machine_only(server):
    assert server.get_host() == "127.0.0.1"
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)} - {"127.0.0.1"}
    for other in others:
        with socket.socket() as probe:
            probe.settimeout(2)
            assert probe.connect_ex((other, server.get_port())) != 0


def test_a_port_that_is_taken_is_named_and_nobody_goes_to_the_next_one(server):
    with (
        pytest.raises(PortTaken, match=rf"port = {server.get_port()} of 127\.0\.0\.1 .*in use.*port=0"),
        open_server(server.get_port(), ""),
    ):
        pass


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_that_cannot_be_is_refused(port):
    with pytest.raises(InvalidSetting, match="port"), open_server(port, ""):
        pass


def test_a_port_is_free_again_after_the_page_is_closed():
    with open_server(0, "") as first:
        port = first.get_port()
    with open_server(port, "") as second:
        assert address(second) == f"http://127.0.0.1:{port}"


def test_nothing_is_printed_about_viewers_strangers_and_connections_that_say_nothing(capfd):
    with open_server(0, "") as server, Client(address(server)):
        with pytest.raises(InvalidStatus):
            Client(address(server), "https://example.org")
        with socket.create_connection(("127.0.0.1", server.get_port())):
            pass
        time.sleep(0.3)
    assert capfd.readouterr() == ("", "")


NAMES = ("localhost", "127.0.0.1", "[::1]", "LOCALHOST")
STRANGERS = ("example.org", "localhost.example.org", "127.0.0.1.example.org", "null", "", "localhost@example.org", "127.0.0.2", "0.0.0.0")


@given(st.sampled_from(NAMES), st.sampled_from(NAMES), st.integers(1, 65535), st.integers(1, 65535))
def test_a_page_of_this_address_may_connect_and_one_of_another_port_may_not(name, other, port, others_port):
    assert guard.refusal(f"{name}:{port}", None) == ""
    assert (guard.refusal(f"{name}:{port}", f"http://{other}:{others_port}") == "") is (port == others_port)
    assert guard.refusal(name, f"http://{other}") == ""
    assert guard.refusal(name, f"http://{other}:{others_port}")


@settings(max_examples=40)
@given(st.sampled_from(STRANGERS) | st.text(max_size=6), st.sampled_from(NAMES), st.integers(1, 65535))
def test_strangers_names_and_pages_are_refused(stranger, name, port):
    assume(stranger.lower() not in map(str.lower, NAMES))
    assert guard.refusal(f"{stranger}:{port}", None)
    for origin in (
        stranger,
        f"http://{stranger}",
        f"https://{stranger}:{port}",
        f"http://{stranger}@{name}:{port}",
        f"file://{name}:{port}",
    ):
        assert guard.refusal(f"{name}:{port}", origin)
    assert guard.refusal(None, None)


def others(server):
    port = server.get_port()
    return (
        "https://example.org",
        "null",
        f"http://127.0.0.1:{port % 65535 + 1}",
        "http://localhost",
        f"http://localhost.example.org:{port}",
    )


def test_a_strangers_web_page_may_not_connect_nor_one_of_another_port(server):
    for origin in others(server):
        with pytest.raises(InvalidStatus, match="403"):
            Client(address(server), origin)


def test_the_page_itself_and_programs_may_connect(server):
    for origin in (None, f"http://localhost:{server.get_port()}", address(server)):
        with Client(address(server), origin) as viewer:
            viewer.wait(lambda: len(server.get_clients()) == 1 or bool(viewer.frames), 10)


def answered(server, host, **headers):
    connection = HTTPConnection("127.0.0.1", server.get_port(), timeout=10)
    connection.request("GET", "/", headers={"Host": host, **headers})
    answer = connection.getresponse()
    return answer, answer.read()


@pytest.mark.parametrize("host", ["example.org", "rebound.example.org:8080", "127.0.0.1.example.org"])
def test_the_page_is_not_served_under_a_strangers_name(server, host):
    answer, content = answered(server, host)
    assert answer.status == 403
    assert len(content) < 200


def test_no_page_may_frame_it_and_it_fetches_nothing_from_elsewhere(server):
    for host, status in ((f"localhost:{server.get_port()}", 200), ("example.org", 403)):
        answer, _ = answered(server, host)
        assert answer.status == status
        policy = answer.headers["Content-Security-Policy"]
        assert "frame-ancestors 'none'" in policy
        assert "example.org" not in policy
        assert answer.headers["X-Frame-Options"] == "DENY"
        assert answer.headers["X-Content-Type-Options"] == "nosniff"


def upgrade(server, version=viser.__version__):
    """A viewer's socket that has shaken hands and reads nothing more, and the first line of the answer; "" if there was none."""
    headers = {
        "Host": f"127.0.0.1:{server.get_port()}",
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        "Sec-WebSocket-Protocol": f"viser-v{version}",
    }
    stream = socket.create_connection(("127.0.0.1", server.get_port()))
    stream.settimeout(10)
    stream.sendall("\r\n".join(["GET / HTTP/1.1", *map(": ".join, headers.items()), "\r\n"]).encode())
    try:
        return stream, stream.recv(64).split(b"\r\n")[0].decode()
    except ConnectionResetError:
        return stream, ""


def test_so_many_viewers_and_no_more(server):
    with contextlib.ExitStack() as stack:
        said = []
        for _ in range(guard.MAX_VIEWERS + 3):
            stream, answer = upgrade(server)
            stack.enter_context(stream)
            said.append(answer)
        assert [" 101 " in line for line in said] == [True] * guard.MAX_VIEWERS + [False] * 3
        assert " 503 " in said[-1]
    wait_for(lambda: " 101 " in upgrade(server)[1])


def test_connections_that_say_nothing_are_not_hoarded(server):
    with contextlib.ExitStack() as stack:
        for _ in range(guard.MAX_CONNECTIONS + 20):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.get_port())))
        more = stack.enter_context(socket.create_connection(("127.0.0.1", server.get_port())))
        more.settimeout(10)
        with contextlib.suppress(ConnectionResetError):
            assert more.recv(1) == b""
    wait_for(lambda: " 101 " in upgrade(server)[1])


def test_a_viewer_of_another_version_is_told_so(server, capfd):
    assert " 400 " in upgrade(server, "0.0.1")[1]
    assert capfd.readouterr().out == ""


def test_a_viewer_that_takes_nothing_is_let_go(server, monkeypatch):
    monkeypatch.setattr(guard, "STALLED_S", 0.3)
    monkeypatch.setattr(guard.Connection, "start_keepalive", lambda self: None)  # pings would find it out, too, but later
    stream, _ = upgrade(server)
    with stream:
        wait_for(lambda: len(server._websock_server._live_connections) == 1)
        picture = server.gui.add_image(np.zeros((8, 8, 3), np.uint8))
        noise = np.random.default_rng(0).integers(0, 255, (600, 800, 3), np.uint8)

        def gone():
            picture.image = np.roll(noise, int(1e6 * time.perf_counter()))
            return not server._websock_server._live_connections

        wait_for(gone)


def test_a_viewer_that_sends_without_end_is_slowed_down(server, monkeypatch):
    monkeypatch.setattr(guard, "BURST", 20.0)
    monkeypatch.setattr(guard, "MESSAGES_HZ", 20.0)
    number = server.gui.add_number("n", 0)
    seen = []
    number.on_update(lambda event: seen.append(event.target.value))
    with Client(address(server)) as viewer:
        begun = time.perf_counter()
        for value in range(1, 60):
            viewer.set("n", value)
        wait_for(lambda: number.value == 59)
        assert time.perf_counter() - begun > 1.0  # some 40 too many at 20 a second


def wait_for(condition, timeout_s=20.0):
    end = time.perf_counter() + timeout_s
    while not condition():
        assert time.perf_counter() < end
        time.sleep(0.02)


def test_what_is_set_from_another_thread_leaves_those_who_wait_to_the_loop():
    """With hundreds of viewers the loop walks through them, while the thread that draws does so too."""

    async def run():
        event, waiting = guard.Buffer(asyncio.get_running_loop(), True).message_event, []
        waiting = [asyncio.ensure_future(event.wait()) for _ in range(5)]
        await asyncio.sleep(0)
        before = [future.done() for future in event._waiters]
        await asyncio.to_thread(event.set)
        assert [future.done() for future in event._waiters] == before
        event.set()
        await asyncio.wait_for(asyncio.gather(*waiting), 5)

    asyncio.run(run())


def test_every_message_buffer_of_a_page_is_guarded(server):
    assert type(server._websock_server.get_message_buffer()) is guard.Buffer


def test_an_update_that_fails_is_written_once_and_the_next_ones_come(caplog):
    ended, calls = threading.Event(), []

    def update(dt_s):
        calls.append(dt_s)
        if len(calls) == 30:
            ended.set()
        raise RuntimeError("deque mutated during iteration")

    keep_updating(update, 1000.0, ended)
    assert len(calls) == 30
    assert [record.getMessage().count("deque mutated") for record in caplog.records] == [1]
    assert caplog.records[0].exc_info


def test_no_viewer_can_publish_the_page(server):
    with Client(address(server)) as viewer:
        viewer.wait(lambda: bool(viewer.frames), 10)
        viewer.send(_messages.ShareUrlRequest())
        time.sleep(0.3)
    assert server.request_share_url() is None
    assert server._share_tunnel is None


def test_updates_come_at_their_rate_and_end_when_told():
    ended, times = threading.Event(), []

    def update(dt_s):
        times.append(dt_s)
        if len(times) == 20:
            ended.set()

    begun = time.perf_counter()
    keep_updating(update, 100.0, ended)
    assert len(times) == 20
    assert time.perf_counter() - begun >= 19 / 100.0 - 1e-3
    assert all(0 <= dt_s <= 0.1 for dt_s in times)


def test_after_much_hurry_the_next_update_is_a_period_away():
    ended, hurry, times = threading.Event(), threading.Event(), []

    def update(dt_s):
        times.append(time.perf_counter())
        if len(times) <= 60:
            hurry.set()
        elif len(times) == 63:
            ended.set()
            hurry.set()

    keep_updating(update, 5.0, ended, hurry)
    assert max(b - a for a, b in pairwise(times)) < 3.0  # with a period for each of them it would be 12 s


def test_a_late_update_is_not_made_up_for():
    ended, times = threading.Event(), []

    def update(dt_s):
        times.append(dt_s)
        if len(times) == 2:
            time.sleep(0.5)
        if len(times) == 20:
            ended.set()

    keep_updating(update, 100.0, ended)
    assert times[2] == 0.1
    assert sum(times[3:]) < 0.5


def test_who_is_in_a_hurry_does_not_wait_for_the_next_update():
    ended, hurry, times = threading.Event(), threading.Event(), []

    def update(dt_s):
        times.append(dt_s)
        if len(times) == 50:
            ended.set()
        hurry.set()

    begun = time.perf_counter()
    keep_updating(update, 2.0, ended, hurry)
    assert time.perf_counter() - begun < 10.0  # at two a second it would be 25 s
