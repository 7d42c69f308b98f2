from __future__ import annotations

import socket
import threading
import time
from itertools import pairwise

import pytest
from viewer_client import Client
from viser import _messages
from websockets.exceptions import InvalidStatus

from marl_handover.errors import InvalidSetting
from marl_handover.viewer.server import PAGES, PortTaken, address, keep_updating, open_server


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


@pytest.mark.parametrize("origin", ["https://example.org", "http://localhost.example.org", "null", "http://127.0.0.1.example.org:8080"])
def test_a_strangers_web_page_may_not_connect(server, origin):
    with pytest.raises(InvalidStatus, match="403"):
        Client(address(server), origin)


@pytest.mark.parametrize("origin", [None, "http://localhost:9000", "http://127.0.0.1:8080", "http://[::1]:80"])
def test_a_page_of_this_machine_may_connect_also_through_a_tunnel(server, origin):
    with Client(address(server), origin) as viewer:
        viewer.wait(lambda: len(server.get_clients()) == 1 or bool(viewer.frames), 10)
    assert origin is None or PAGES.fullmatch(origin)


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
