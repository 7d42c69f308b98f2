"""``marl-handover doctor`` asks for what the package says that it needs, and for nothing else."""

from __future__ import annotations

import itertools
import os
import sys
import threading
import tomllib
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
import serial
from packaging.requirements import Requirement

from marl_handover.cli import main
from marl_handover.commands import doctor
from marl_handover.config import ENGINES
from marl_handover.errors import CORE, applies, by_extra, name_of, requirements
from marl_handover.hardware import session_registry, settings, transport
from marl_handover.hardware.emulator.board import EmulatedBoard
from marl_handover.hardware.emulator.device import EmulatedDevice
from marl_handover.hardware.emulator.pty import PtyEmulator
from marl_handover.hardware.estop import StopLatch
from marl_handover.simulation import engine

PROJECT = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]


def _here(lines):
    """Requirements whose conditions hold here, without these, as ``packaging`` reads them."""
    read = map(Requirement, lines)
    return [Requirement(f"{line.name}{line.specifier}") for line in read if line.marker is None or line.marker.evaluate({"extra": ""})]


def test_every_requirement_of_this_python_is_looked_for_under_its_name():
    needed = requirements()
    assert list(needed) == [CORE, *EXTRAS]
    for extra, lines in {CORE: PROJECT["dependencies"], **EXTRAS}.items():
        found = [Requirement(line.replace("[python]", "")) for line in needed[extra]]
        assert found == _here(lines), extra
        assert [name_of(line) for line in needed[extra]] == [line.name for line in found]


def test_an_installed_packages_metadata_says_the_same_as_the_checkout():
    metadata = [*PROJECT["dependencies"], "tomli>=2; python_version < '3.11'", "more>=2; python_version > '3.10'"]
    metadata += [f"{line}; extra == '{extra}'" for extra, lines in EXTRAS.items() for line in lines]
    found, needed = by_extra(metadata), requirements()
    assert found == {**needed, CORE: (*needed[CORE], "more>=2")}


CONDITIONS = [f"python_version {sign} '{version}'" for sign in ("<", "<=", ">", ">=") for version in ("3.9", "3.11", "3.12", "3.13", "4.0")]


@pytest.mark.parametrize("python", [(3, 9), (3, 11), (3, 12), (3, 13), (3, 14)])
def test_a_condition_on_pythons_version_holds_where_packaging_says_that_it_does(python):
    environment = {"python_version": "{}.{}".format(*python), "extra": "more"}
    for condition in [*CONDITIONS, f"{CONDITIONS[0]} and {CONDITIONS[-1]}", f"{CONDITIONS[-1]} and extra == 'more'", "extra == 'more'"]:
        line = f"some-package>=1; {condition}"
        assert applies(line, python) == Requirement(line).marker.evaluate(environment), condition
    assert applies("some-package>=1", python)


def test_packages_of_an_extra_that_are_missing_are_named_with_the_line_that_installs_them(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "requirements", lambda: {CORE: (), "more": ("numpy", "no-such-package>=3")})
    monkeypatch.setattr(doctor, "install_line", lambda extra: f"the line for {extra}")
    doctor.run(doctor.DoctorConfig())
    assert "[more]" in (out := capsys.readouterr().out)
    assert "missing no-such-package; run: the line for more" in out


def _told_engines(capsys) -> dict[str, str]:
    doctor.run(doctor.DoctorConfig())
    lines = capsys.readouterr().out.partition("physics engines\n")[2].splitlines()
    return {
        line.split()[0]: line.partition(line.split()[0])[2].strip()
        for line in itertools.takewhile(lambda line: line.startswith("  "), lines)
    }


@pytest.mark.parametrize(("here", "used"), [({"pybullet", "mujoco"}, "bullet"), ({"pybullet"}, "bullet"), ({"mujoco"}, "mujoco")])
def test_the_engine_in_use_is_named_and_the_line_that_installs_the_other(here, used, monkeypatch, capsys):
    packages = {"bullet": "pybullet", "mujoco": "mujoco"}
    monkeypatch.setattr(doctor, "version", lambda package: "1.2.3" if package in here else _missing(package))
    monkeypatch.setattr(engine, "default_engine", lambda: used)
    told = _told_engines(capsys)
    assert list(told) == ["bullet", "mujoco"]
    for name, said in told.items():
        if packages[name] not in here:
            assert said.startswith(f"not installed; run: pip install '{EXTRAS[name][0]}'")
            assert ("built from source" in said) == (name == "bullet" and sys.version_info >= (3, 12))
        else:
            assert said == f"{packages[name]} 1.2.3" + (", in use where none is named" if name == used else "")


def _missing(package):
    raise PackageNotFoundError(package)


def test_what_is_in_use_is_what_opens(capsys):
    told = _told_engines(capsys)
    (used,) = [name for name, said in told.items() if "in use" in said]
    assert used == engine.default_engine()
    assert used in ENGINES


@pytest.fixture
def board(tmp_path):
    """``board(baud)``: the path of a port with an emulated controller behind it."""
    running = []

    def make(baud=115200):
        emulator, over = PtyEmulator(EmulatedDevice(EmulatedBoard(), baud=baud), tmp_path / f"ssc32-{baud}"), threading.Event()
        thread = threading.Thread(target=emulator.serve, args=(over.is_set,))
        thread.start()
        running.append((emulator, over, thread))
        return emulator

    yield make
    for emulator, over, thread in running:
        over.set()
        thread.join()
        emulator.close()


def test_a_controller_that_is_asked_says_who_it_is_and_at_which_rate(board, capsys):
    fast, slow = board(), board(9600)
    assert main(["doctor", f"port={fast.link}"]) == 0
    assert f"{fast.link}: SSC32-V2.50USB at 115200 baud\n" in capsys.readouterr().out
    assert main(["doctor", f"port={slow.link}"]) == 0
    assert "SSC32-V2.50USB at 9600 baud; too slow" in capsys.readouterr().out
    assert not [line for _, line in fast.device.lines if not line.endswith(b"VER\r")], "it is asked who it is, and nothing else"


def test_a_port_that_is_not_there_or_in_use_is_said_to_be(board, tmp_path, capsys):
    assert main(["doctor", f"port={tmp_path / 'none'}"]) == 0
    assert "cannot be opened" in capsys.readouterr().out
    link = board().link
    with serial.Serial(str(link), exclusive=True):
        assert main(["doctor", f"port={link}"]) == 0
    assert "cannot be opened" in capsys.readouterr().out


def test_ports_are_asked_only_if_that_is_wanted(board, monkeypatch, capsys):
    emulator = board()
    monkeypatch.setattr(transport, "list_serial_ports", lambda: [transport.PortInfo(str(emulator.link), "FT232R", True)])
    main(["doctor"])
    out = capsys.readouterr().out
    assert f"{emulator.link}  FT232R, may be a controller" in out
    assert "doctor ask=true" in out
    assert not emulator.device.lines
    main(["doctor", "ask=true"])
    assert "SSC32-V2.50USB at 115200 baud" in capsys.readouterr().out


def test_the_latched_stop_and_running_sessions_are_named(tmp_path, monkeypatch, capsys):
    for module in (session_registry, settings):
        monkeypatch.setattr(module, "user_path", lambda suffix: tmp_path / f"user{suffix}")
    latch = StopLatch(settings.HardwareConfig().stop_path())
    latch.join()
    main(["doctor"])
    out = capsys.readouterr().out
    assert "no stop is latched" in out
    assert f"process {os.getpid()}" in out
    latch.latch("smoke")
    latch.leave()
    main(["doctor"])
    out = capsys.readouterr().out
    assert "the stop is latched (smoke)" in out
    assert f"process {os.getpid()}" not in out


def test_the_latency_of_a_usb_chip(tmp_path, monkeypatch):
    monkeypatch.setattr(transport, "_USB_SERIAL", tmp_path)
    (tmp_path / "ttyUSB7").mkdir()
    (tmp_path / "ttyUSB7" / "latency_timer").write_text("16\n")
    assert transport.latency_ms("/dev/ttyUSB7") == 16
    assert transport.latency_ms("/dev/ttyUSB8") is None
