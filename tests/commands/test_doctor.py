"""``marl-handover doctor`` asks for what the package says that it needs, and for nothing else."""

from __future__ import annotations

import tomllib
from pathlib import Path

from packaging.requirements import Requirement

from marl_handover.commands import doctor

PROJECT = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]


def names(requirements) -> tuple[str, ...]:
    return tuple(Requirement(line).name for line in requirements)


def test_every_requirement_is_looked_for():
    assert names(PROJECT["dependencies"]) == doctor.CORE
    assert {extra: names(lines) for extra, lines in EXTRAS.items()} == doctor.EXTRAS


def test_an_installed_packages_metadata_says_the_same_as_the_checkout():
    metadata = [*PROJECT["dependencies"], "tomli>=2; python_version < '3.11'"]
    metadata += [f"{line}; extra == '{extra}'" for extra, lines in EXTRAS.items() for line in lines]
    core, extras = doctor._sorted_out(metadata)
    assert core == (*doctor.CORE, "tomli")
    assert extras == doctor.EXTRAS


def test_packages_of_an_extra_that_are_missing_are_named_with_the_line_that_installs_them(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "EXTRAS", {"more": ("numpy", "no-such-package")})
    doctor.run(doctor.DoctorConfig())
    assert "[more]" in (out := capsys.readouterr().out)
    assert "missing no-such-package; run: pip install 'marl_handover[more]'" in out
