"""``marl-handover doctor``: what is installed, what is plugged in, what is missing and the line that installs it."""

from __future__ import annotations

import importlib
import importlib.util
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from marl_handover.errors import CORE, PACKAGE, counted, install_line, name_of, requirements


@dataclass
class DoctorConfig:
    """Keys of ``doctor``."""

    ask: bool = False  # open every port that looks like a controller's, and ask who is there; nothing moves
    port: str = ""  # ask at this one as well, whatever it looks like


SCHEMA: type = DoctorConfig
ALIASES: dict[str, str] = {}
GROUPS: dict[str, dict[str, type]] = {}


def run(config: DoctorConfig) -> int:
    """Print the report. Returns 1 if a package is missing without which nothing works, else 0."""
    core = tuple(map(name_of, requirements().get(CORE, ())))
    missing = [package for package in core if _installed(package) is None]
    sections = {
        "system": _system(),
        "packages": _packages(core),
        "physics engines": _engines(),
        "devices": _devices(),
        "compiler": _compiler(),
        "cameras": _listed("/dev", "video*", "none found"),
        "serial ports": _ports(config),
        "arms": _arms(),
        "extras": _extras(),
    }
    for title, lines in sections.items():
        print(title)
        for line in lines:
            print(f"  {line}")
    if missing:
        print(f"missing: {', '.join(missing)}; run: {install_line(CORE, missing)}")
        return 1
    return 0


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _packages(packages: tuple[str, ...]) -> Iterator[str]:
    for package in packages:
        yield f"{package:<27} {_installed(package) or 'MISSING'}"


def _engines() -> Iterator[str]:
    """Which physics engines are here, which one is taken where none is named, and the line that installs another."""
    try:
        from marl_handover.config import ENGINES
        from marl_handover.simulation.engine import default_engine
    except ImportError as error:
        yield f"cannot be listed: {error}"
        return
    used, extras = default_engine(), requirements()
    for engine in filter(extras.get, ENGINES):  # a plugin's has no extra
        package = name_of(extras[engine][0])
        if found := _installed(package):
            yield f"{engine:<14} {package} {found}{', in use where none is named' if engine == used else ''}"
        else:
            yield f"{engine:<14} not installed; run: {install_line(engine)}{_FROM_SOURCE if package == 'pybullet' else ''}"


_FROM_SOURCE = "" if sys.version_info < (3, 12) else " (no wheel for this Python: built from source, which needs g++ and some ten minutes)"


def _system() -> Iterator[str]:
    yield f"marl_handover  {_installed(PACKAGE) or 'not installed (running from a checkout)'}"
    yield f"python         {platform.python_version()} ({sys.executable})"
    yield f"platform       {platform.platform()}"
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    yield f"cores          {usable} usable of {os.cpu_count()}"


def _devices() -> Iterator[str]:
    try:
        torch: Any = importlib.import_module("torch")
    except (ImportError, OSError) as error:  # OSError: a shared library that torch needs is not there
        yield f"torch cannot be imported: {' '.join(str(error).split())}"
        return
    yield f"cpu            {counted(torch.get_num_threads(), 'thread')}"
    if not torch.cuda.is_available():
        yield "cuda           not available; device=cpu is used"
    for index in range(torch.cuda.device_count()):
        yield f"cuda:{index}         {torch.cuda.get_device_name(index)}"


def _compiler() -> Iterator[str]:
    """torch.compile needs a C++ compiler and Python's headers; both are often absent on a bare machine."""
    import sysconfig

    candidates = [os.environ.get("CXX"), "g++", "clang++"]
    found = next((path for name in candidates if name and (path := shutil.which(name))), None)
    headers = Path(sysconfig.get_path("include")) / "Python.h"
    yield f"C++ compiler   {found}" if found else "C++ compiler   none, so torch.compile cannot be used; run: apt install g++"
    if not headers.is_file():
        major, minor = sys.version_info[:2]
        yield f"Python.h       none, so torch.compile cannot be used; run: apt install python{major}.{minor}-dev"
    yield _film_encoder()
    try:
        from marl_handover.compiled import cache_place
    except ImportError:
        return
    place, trouble = cache_place()
    yield f"kernels        kept in {place}" if place else f"kernels        compiled anew each time: {trouble}; set NUMBA_CACHE_DIR=FOLDER"


def _film_encoder() -> str:
    """Where ffmpeg is: imageio-ffmpeg brings it along on most machines, and finds the system's on others."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return f"ffmpeg         {get_ffmpeg_exe()}"
    except (ImportError, RuntimeError):
        return "ffmpeg         none, so no MP4 can be written (GIF can); install it, or set IMAGEIO_FFMPEG_EXE=FILE"


def _listed(folder: str, pattern: str, otherwise: str) -> Iterator[str]:
    """Names only: opening a device could disturb whoever uses it."""
    found = sorted(Path(folder).glob(pattern)) if Path(folder).is_dir() else []
    if not found:
        yield otherwise
    for path in found:
        yield f"{path}{_access(path)}"


def _access(path: Path) -> str:
    if os.access(path, os.R_OK | os.W_OK):
        return ""
    return f"  (no permission; run: sudo usermod -aG {_group(path)} $USER, and log in again)"


def _ports(config: DoctorConfig) -> Iterator[str]:
    """Ports by their lasting names; who is at them only if that is asked for: opening a port resets some devices."""
    try:
        from marl_handover.hardware.transport import latency_ms, list_serial_ports
    except ImportError as error:
        yield f"cannot be listed: {error}"
        return
    ports = list_serial_ports()
    if not ports:
        yield "none found"
    for port in ports:
        latency = latency_ms(port.path)
        timer = "" if latency is None else f", hands bytes over after {latency} ms"
        kind = ", may be a controller" if port.likely else ", may be a bus of servos" if port.bus else ""
        yield f"{port.path}  {port.description}{kind}{timer}{_access(Path(port.path))}"
        if config.ask and (port.likely or port.bus) and port.path != config.port:
            yield f"  {_who(port.path)}"
    if config.port:
        yield f"{config.port}: {_who(config.port)}"
    elif any(port.likely or port.bus for port in ports) and not config.ask:
        yield "who is there, and at which rate: marl-handover doctor ask=true"


def _who(port: str) -> str:
    """What the controller, or the bus servos, at a port say that they are, or why nobody says anything."""
    from marl_handover.hardware.clock import RealClock
    from marl_handover.hardware.errors import BoardSilent, DeviceError
    from marl_handover.hardware.settings import BoardConfig, TimeoutConfig
    from marl_handover.hardware.ssc32 import Ssc32

    board = Ssc32("asked", BoardConfig(port), TimeoutConfig(), RealClock())
    try:
        firmware, best = board.connect().text, BoardConfig().baud
        slow = "" if board.wire.baud == best else f"; too slow to stop two arms in time: set the board to {best}, see docs/hardware.md"
        return f"{firmware} at {board.wire.baud} baud{slow}"
    except BoardSilent as error:
        return _servos(port) or f"{error}; nor do bus servos answer"
    except DeviceError as error:
        return str(error)
    finally:
        board.close()


def _servos(port: str) -> str:
    """What bus servos at a port say of themselves, as far as it matters for safety; empty if none answers at any rate."""
    from marl_handover.hardware.clock import RealClock
    from marl_handover.hardware.errors import DeviceError
    from marl_handover.hardware.feetech import FeetechBus
    from marl_handover.hardware.settings import SERVO_BAUDS, BoardConfig, TimeoutConfig

    for baud in SERVO_BAUDS:
        bus = FeetechBus("asked", BoardConfig(port, baud), TimeoutConfig(reply_s=0.02, retries=1), RealClock())
        try:
            bus.open([])
            found = bus.scan()
            if not found:
                continue
            names = ("model", "firmware", "present_voltage", "torque_enable", "lock", "return_delay")
            said = []
            for servo in found:
                model, firmware, volts, torque, lock, delay = (bus.read(servo, name) for name in names)
                state = f"torque {'on' if torque else 'off'}, lock {'shut' if lock else 'open'}, return delay {2 * delay} us"
                said.append(f"{servo}: model {model}, firmware {firmware & 0xFF}.{firmware >> 8}, {volts / 10:g} V, {state}")
            return f"bus servos at {baud} baud; " + "; ".join(said)
        except DeviceError as error:
            return str(error)
        finally:
            bus.close()
    return ""


def _arms() -> Iterator[str]:
    """The latched stop, and which sessions could move arms now."""
    from marl_handover.hardware.estop import StopLatch
    from marl_handover.hardware.session_registry import SessionRegistry
    from marl_handover.hardware.settings import TWIN, HardwareConfig

    latch, twins = StopLatch(HardwareConfig().stop_path()), StopLatch(HardwareConfig(name=TWIN).stop_path())
    if latch.is_set():
        yield f"the stop is latched ({latch.reason()}), so nothing moves; allow motion again: marl-handover stop clear=true"
    else:
        yield "no stop is latched"
    if twins.is_set():
        yield f"the twin's stop is latched ({twins.reason()}); allow motion again: marl-handover stop clear=true"
    running = SessionRegistry().registered()
    yield f"sessions that run: {', '.join(f'process {session.pid}' for session in running) or 'none'}"
    for session in SessionRegistry().others():
        certain = "runs one" if session.stop_file else "may run one"
        yield f"{session.owner} {certain} too, process {session.pid}: only {session.owner} can stop it"


def _group(path: Path) -> str:
    try:
        return path.group()
    except (KeyError, OSError, NotImplementedError):
        return "dialout"


def _extras() -> Iterator[str]:
    for extra, needed in requirements().items():
        if extra == CORE:
            continue
        missing = [package for package in map(name_of, needed) if _installed(package) is None]
        yield f"[{extra}]".ljust(15) + (f"missing {', '.join(missing)}; run: {install_line(extra)}" if missing else "complete")
