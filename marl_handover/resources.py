"""Files that travel with the package: configs, the URDF, pretrained policies."""

from __future__ import annotations

from pathlib import Path

from marl_handover.errors import MissingFile

_PACKAGE = Path(__file__).resolve().parent


def resource_path(relative: str) -> Path:
    """Path of a shipped file or folder, such as ``"configs"`` or ``"urdf/al5a.urdf"``.

    In a wheel the files lie in ``marl_handover/resources/``; in a checkout or an editable install, beside the package.
    Raises :class:`MissingFile` if it is in neither place.
    """
    for root in (_PACKAGE / "resources", _PACKAGE.parent):
        path = root / relative
        if path.exists():
            return path
    raise MissingFile("resource", relative, "reinstall the package")


def package_path(relative: str) -> Path:
    """Path of a file inside the package folder itself, such as ``"pretrained/b.npz"``. Raises :class:`MissingFile`."""
    path = _PACKAGE / relative
    if not path.exists():
        raise MissingFile("resource", relative, "reinstall the package")
    return path
