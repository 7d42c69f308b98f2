"""The browser page in numbers: how soon a drag is followed, how many updates every viewer gets, how much memory it takes in the long run.

python bench/viewer.py drags=300 viewers=4 seconds=20 steps=10000 minutes=10 policy=exact results=bench/results
python bench/viewer.py bases=200 cell=ring6 policy=exact
python bench/viewer.py crowd=1500 crowd_seconds=120

The second line drags bases of arms, to and fro by some mm, while the arms play: how soon a viewer sees the spaces that are shared then, the
fewest transfers, and the first sample of the motion that is planned anew. The third line measures something else: one viewer of each page,
while so many sockets connect, read nothing, and connect again some seconds after they are let go. The viewers are programs that speak
viser's protocol, in this process; the page is served by another one, ``marl-handover view``.
"""

from __future__ import annotations

import contextlib
import datetime
import io
import json
import math
import multiprocessing
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))
import numpy as np
import viser
from common import ROOT, commit, machine, parse, table
from viewer_client import Client
from websockets.exceptions import ConnectionClosed, InvalidHandshake

from marl_handover import cli
from marl_handover.cell import Cell, cell_config, load_cell
from marl_handover.control.telemetry_reader import FORMAT, STATE_FILE, VERSION
from marl_handover.files import write_whole
from marl_handover.viewer.words import flat

DEFAULTS = {
    "drags": 300,
    "bases": 0,
    "cell": "ring6",
    "viewers": 4,
    "seconds": 20,
    "steps": 10000,
    "minutes": 10,
    "policy": "exact",
    "seed": 0,
    "results": "bench/results",
    "crowd": 0,
    "crowd_seconds": 120,
}
LIMIT_MS, LIMIT_HZ, LIMIT_BASE_MS = 100.0, 20.0, 250.0
BASE_MM, BASE_RAD = 12.0, 0.1
"""How far a base is dragged from where it stands."""
SCRUB_HZ = 30.0
AGAIN_S = 5.0
UPDATE_S = 1 / 60
"""What comes within this is one update: the server sends no more often."""


@contextlib.contextmanager
def page(*arguments: str) -> Iterator[tuple[str, int]]:
    """A page in a process of its own: its address and the process."""
    command = [sys.executable, "-m", "marl_handover.cli", "view", "port=0", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().split()[1], process.pid
        finally:
            process.terminate()


@contextlib.contextmanager
def watched(address: str, viewers: int) -> Iterator[list[Client]]:
    """So many viewers, all of whom have seen the cell."""
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(Client(address)) for _ in range(viewers)]
        for client in clients:
            client.wait(lambda client=client: any("position" in node for node in client.nodes.values()), 60)  # type: ignore[misc]
        yield clients


def places(count: int, seed: int) -> np.ndarray:
    """Poses (count, 3) that the paper's arms reach."""
    cell, random = load_cell(), np.random.default_rng(seed)
    poses = random.uniform([-230, -180, -np.pi], [230, 180, np.pi], (20 * count, 3))
    return poses[cell.reaches(poses).any(-1)][:count]


def drag(client: Client, pose: np.ndarray) -> float:
    """Drag the goal to ``pose``; the ms until the page shows it there, which it does with the first sample of the new motion."""
    wxyz, position = (part.tolist() for part in flat(pose, 8.0))
    begun = time.perf_counter()
    client.drag("/goal_handle", position, wxyz)
    client.drag("/goal_handle", position, wxyz, "end")
    there = client.wait(lambda: np.hypot(*(np.asarray(client.nodes["/goal"]["position"][:2]) - position[:2])) < 1e-6, 30)
    return 1e3 * (there - begun)


def drags(client: Client, count: int, seed: int) -> list[float]:
    """Latencies in ms of drags at random moments, most of them in mid-motion."""
    random = np.random.default_rng(seed)
    times = []
    for pose in places(count, seed):
        time.sleep(random.uniform(0.05, 1.0))
        times.append(drag(client, pose))
    return times


def base_drags(client: Client, cell: Cell, count: int, seed: int) -> list[float]:
    """Latencies in ms of drags of bases at random moments, most of them in mid-motion.

    The page shows arm, spaces, optimum and the first sample of the new motion in one piece, so that the arm's base tells of them all.
    """
    random, times = np.random.default_rng(seed), []
    for _ in range(count):
        time.sleep(random.uniform(0.05, 1.0))
        arm = int(random.integers(cell.num_arms))
        base = cell.bases[arm]
        offset = random.uniform(-1, 1, 3) * [BASE_MM, BASE_MM, BASE_RAD]
        wxyz, position = flat([base.x_mm, base.y_mm, base.facing_rad] + offset, 5.0)
        at = np.round(1e3 * position[:2], 1)
        begun = time.perf_counter()
        client.drag(f"/base_0_{arm}", position.tolist(), wxyz.tolist())
        client.drag(f"/base_0_{arm}", position.tolist(), wxyz.tolist(), "end")

        def there(arm: int = arm, at: np.ndarray = at) -> bool:
            return bool(np.abs(1e3 * np.asarray(client.nodes[f"/arm_{arm}"]["position"][:2]) - at).max() < 1e-3)

        times.append(1e3 * (client.wait(there, 30) - begun))
    return times


def bases(settings: dict[str, Any]) -> None:
    """Drag bases, and tell how soon that is followed."""
    cell = load_cell(settings["cell"])
    with contextlib.ExitStack() as stack:
        arguments = f"cell={settings['cell']}", f"policy={settings['policy']}", f"seed={settings['seed']}"
        address, pid = stack.enter_context(page(*arguments))
        (client,) = stack.enter_context(watched(address, 1))
        base_drags(client, cell, 5, settings["seed"] + 1)
        before_s, begun = cpu_s(pid), time.perf_counter()
        times = base_drags(client, cell, settings["bases"], settings["seed"])
        share = (cpu_s(pid) - before_s) / (time.perf_counter() - begun)
    rows = [
        [f"base to spaces, optimum and motion, {cell.num_arms} arms, p{q}", f"{np.percentile(times, q):.0f} ms", f"{LIMIT_BASE_MS:.0f} ms"]
        for q in (50, 95, 99)
    ]
    rows.append(["of a core, for the page", f"{share:.2f}", ""])
    print(table(["what", "measured", "limit"], rows))


def cpu_s(pid: int) -> float:
    """Processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def updates(clients: list[Client], seconds: float, meanwhile: Callable[[float], None] = time.sleep) -> list[float]:
    """Updates a second that each viewer gets while ``meanwhile`` goes on for so many seconds."""
    before = [len(client.frames) for client in clients]
    begun = time.perf_counter()
    meanwhile(seconds)
    spent = time.perf_counter() - begun
    gaps = [np.diff(client.frames[first:]) for client, first in zip(clients, before, strict=True)]
    return [float((gap > UPDATE_S / 4).sum()) / spent for gap in gaps]


def scrubbed(client: Client, seconds: float) -> None:
    """Somebody pulls the slider to and fro."""
    slider = client.input("moment")
    end, share = time.perf_counter() + seconds, 0.0
    last = client.panel[slider]["max"]
    while time.perf_counter() < end:
        share = (share + 0.37 / SCRUB_HZ) % 1.0
        client.set("moment", round(share * last))
        time.sleep(1 / SCRUB_HZ)


def memory_mb(pid: int) -> float:
    """Resident memory of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith("VmRSS"))) / 1024


def long_trace(folder: Path, steps: int) -> Path:
    """A trace of at least so many transfers."""
    path = folder / "trace.jsonl"
    with contextlib.redirect_stdout(io.StringIO()):
        cli.main(["evaluate", "policy=exact", f"episodes={steps // 2}", f"trace={path}", "progress=false"])
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:steps]))
    return path


def in_the_long_run(pages: list[tuple[str, int]], viewers: int, minutes: float, seed: int) -> list[list[float]]:
    """Memory in MB of each page's process, once before and then every minute, while the goal is dragged and the trace is scrubbed."""
    seen = [[memory_mb(pid)] for _, pid in pages]
    with contextlib.ExitStack() as stack:
        play, trace = (stack.enter_context(watched(address, viewers)) for address, _ in pages)
        for minute in range(round(minutes)):
            end = time.perf_counter() + 60
            while time.perf_counter() < end:
                drags(play[0], 3, seed + minute)
                scrubbed(trace[0], 2.0)
                for client in (*play, *trace):
                    client.frames.clear()
            for row, (_, pid) in zip(seen, pages, strict=True):
                row.append(memory_mb(pid))
            print(f"minute {minute + 1}: play {seen[0][-1]:.0f} MB, trace {seen[1][-1]:.0f} MB", flush=True)
    return seen


def connected(port: int) -> socket.socket:
    """A viewer's socket, on its way."""
    stream = socket.socket()
    stream.setblocking(False)
    stream.connect_ex(("127.0.0.1", port))
    return stream


def press(port: int, count: int, ended: Any) -> None:
    """``count`` sockets, in a process of its own: every one is a viewer that reads nothing, and comes again when it is let go."""
    headers = ("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==")
    lines = ("GET / HTTP/1.1", f"Host: 127.0.0.1:{port}", *headers, f"Sec-WebSocket-Protocol: viser-v{viser.__version__}", "", "")
    asked = "\r\n".join(lines).encode()
    streams = {connected(port): False for _ in range(count)}
    away: deque[float] = deque()
    """Times at which those who were let go come again."""
    while not ended.wait(0.1):
        for stream, greeted in list(streams.items()):
            try:
                if not greeted:
                    stream.sendall(asked)
                    streams[stream] = True
                elif not stream.recv(12, socket.MSG_PEEK).endswith(b"101"):
                    raise ConnectionResetError
            except BlockingIOError:
                continue
            except OSError:
                stream.close()
                del streams[stream]
                away.append(time.monotonic() + AGAIN_S)
        while away and away[0] < time.monotonic():
            away.popleft()
            streams[connected(port)] = False


@contextlib.contextmanager
def crowded(address: str, count: int) -> Iterator[None]:
    """Meanwhile a crowd presses."""
    ended = multiprocessing.Event()
    process = multiprocessing.Process(target=press, args=(int(address.rsplit(":", 1)[1]), count, ended))
    process.start()
    try:
        yield
    finally:
        ended.set()
        process.join()


@contextlib.contextmanager
def session(folder: Path) -> Iterator[None]:
    """What a session with two moving arms publishes in ``folder``, some 50 times a second."""
    ended = threading.Event()
    cell = asdict(cell_config("paper"))
    fixed = {"format": FORMAT, "version": VERSION, "session": "bench", "pid": os.getpid(), "over": False, "view_control": False}
    fixed |= {"doing": "moving", "text": "", "phase": "transfer", "cell": cell, "host": os.uname().nodename}

    def publish() -> None:
        while not ended.wait(0.02):
            now = time.time()
            arms = [{"joints_rad": [0.3 * np.sin(now), 1.0, -1.0, 0.0, 0.0], "gripper_mm": None, "holding": False} for _ in range(2)]
            write_whole(folder / STATE_FILE, json.dumps(fixed | {"time": now, "quiet_s": 0.0, "arms": arms}))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def wait_for_a_place(address: str) -> float:
    """The time in s until one more viewer is let in among the crowd."""
    begun = time.perf_counter()
    while time.perf_counter() < begun + 60.0:
        with contextlib.suppress(OSError, InvalidHandshake, ConnectionClosed), Client(address) as client:
            client.wait(lambda: bool(client.frames), 10)
            return time.perf_counter() - begun
        time.sleep(0.1)
    return math.inf


def crowds(settings: dict[str, Any]) -> dict[str, Any]:
    """One viewer's updates a second, the new viewer's wait in s and the memory in MB of every page, while a crowd presses."""
    rows: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        live = folder / "live"
        live.mkdir()
        trace = long_trace(folder, settings["steps"])
        pages = {"play": (f"policy={settings['policy']}",), "trace": (f"trace={trace}",), "live": (f"live={live}",)}
        for what, arguments in pages.items():
            with contextlib.ExitStack() as stack:
                if what == "live":
                    stack.enter_context(session(live))
                address, pid = stack.enter_context(page(*arguments))
                (viewer,) = stack.enter_context(watched(address, 1))
                if what == "trace":
                    viewer.set("play", True)
                memory = [memory_mb(pid)]
                with crowded(address, settings["crowd"]):
                    hz = updates([viewer], settings["crowd_seconds"])[0]
                    memory.append(memory_mb(pid))
                    wait_s = wait_for_a_place(address)
                rows[what] = {"updates_hz": hz, "memory_mb": memory, "new_viewer_s": wait_s, "alive": Path(f"/proc/{pid}").exists()}
                print(what, rows[what], flush=True)
    return rows


def main(arguments: list[str]) -> None:
    settings = parse(arguments, DEFAULTS)
    if settings["bases"]:
        bases(settings)
        return
    if settings["crowd"]:
        crowds(settings)
        return
    results: dict[str, Any] = {"settings": settings, "machine": machine(1), "commit": commit()}
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        trace = long_trace(Path(name), settings["steps"])
        playing = stack.enter_context(page(f"policy={settings['policy']}", f"seed={settings['seed']}"))
        with watched(playing[0], 1) as clients:
            results["drag_ms"] = drags(clients[0], settings["drags"], settings["seed"])
        with watched(playing[0], settings["viewers"]) as clients:
            results["updates_play_hz"] = updates(clients, settings["seconds"])
            results["drag_crowded_ms"] = drags(clients[0], settings["drags"] // 3, settings["seed"] + 1)
        scrubbing = stack.enter_context(page(f"trace={trace}"))
        with watched(scrubbing[0], settings["viewers"]) as clients:
            results["updates_trace_hz"] = updates(clients, settings["seconds"], partial(scrubbed, clients[0]))
        results["memory_mb"] = in_the_long_run([playing, scrubbing], settings["viewers"], settings["minutes"], settings["seed"])
    tell(results)
    folder = ROOT / settings["results"] / datetime.date.today().isoformat()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "viewer.json").write_text(json.dumps(results, indent=1) + "\n")


def tell(results: dict[str, Any]) -> None:
    settings, rows = results["settings"], []
    for key, viewers in (("drag_ms", 1), ("drag_crowded_ms", settings["viewers"])):
        for q in (50, 95, 99):
            time_ms = float(np.percentile(results[key], q))
            what = f"drag to first new motion, {viewers} looking, p{q}"
            rows.append([what, f"{time_ms:.0f} ms", f"{time_ms / LIMIT_MS:.2f} of {LIMIT_MS:.0f} ms"])
    for what in ("play", "trace"):
        least = min(results[f"updates_{what}_hz"])
        rows.append(
            [
                f"updates to each of {settings['viewers']} viewers, {what}",
                f"{least:.0f} / s",
                f"{least / LIMIT_HZ:.1f} of {LIMIT_HZ:.0f} / s",
            ]
        )
    for what, memory in zip(("play", "trace"), results["memory_mb"], strict=True):
        first = memory[min(1, len(memory) - 1)]
        rows.append([f"memory, minutes 1 to {len(memory) - 1}, {what}", f"{memory[-1]:.0f} MB", f"{memory[-1] - first:+.0f} MB"])
    print(table(["what", "measured", "against the limit"], rows))


if __name__ == "__main__":
    main(sys.argv[1:])
