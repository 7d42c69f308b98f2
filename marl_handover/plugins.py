"""Names that can be added to: algorithms, backends, policies, observation layouts. Each is one Python file, found by its name.

A file adds a name with ``register`` of the :class:`Registry` that it belongs to. Files of your own are listed in the environment
variable ``MARL_HANDOVER_PLUGINS``, which ``plugins=`` of every command sets; worker processes are told of it by a :class:`Parcel`.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import cloudpickle

from marl_handover.errors import CorruptFile, HandoverError, MissingFile, UnknownChoice, first_line
from marl_handover.files import expanded

VARIABLE = "MARL_HANDOVER_PLUGINS"
"""Environment variable: paths of Python files, separated as those of ``PATH`` are."""

Entry = TypeVar("Entry")

_loaded: set[str] = set()


class Registry(Mapping[str, Entry]):
    """What names stand for.

    Args:
        what: kind of the entries, for messages.
        shipped: name -> ``module:attribute``, imported when the name is used and not before.
    """

    def __init__(self, what: str, shipped: Mapping[str, str] | None = None) -> None:
        self.what, self._shipped = what, dict(shipped or {})
        self._entries: dict[str, Entry] = {}

    def register(self, name: str) -> Callable[[Entry], Entry]:
        """A decorator that makes ``name`` stand for what it decorates."""

        def add(entry: Entry) -> Entry:
            self._entries[name] = entry
            return entry

        return add

    def without(self, *names: str) -> Choices:
        """All names but these, now and later."""
        return Choices(self, names)

    def __getitem__(self, name: str) -> Entry:
        if name in self._entries:
            return self._entries[name]
        if name not in self:
            raise UnknownChoice(self.what, name, self)
        if name not in self._entries:
            module, _, attribute = self._shipped[name].partition(":")
            self._entries[name] = getattr(importlib.import_module(module), attribute)
        return self._entries[name]

    def __contains__(self, name: object) -> bool:
        load_plugins()
        return name in self._shipped or name in self._entries

    def __iter__(self) -> Iterator[str]:
        load_plugins()
        return iter(dict.fromkeys([*self._shipped, *self._entries]))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __eq__(self, other: object) -> bool:
        return self is other

    __hash__ = object.__hash__


class Choices(Collection[str]):
    """The names of a registry that a setting may have."""

    def __init__(self, registry: Registry[Any], left_out: tuple[str, ...]) -> None:
        self._registry, self._left_out = registry, left_out

    def __contains__(self, name: object) -> bool:
        return name in self._registry and name not in self._left_out

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._registry if name not in self._left_out)

    def __len__(self) -> int:
        return len(list(iter(self)))


@contextmanager
def added(paths: Iterable[str]) -> Iterator[None]:
    """Within, these Python files are listed too, for this process and those that it starts. What they registered stays.

    Raises:
        MissingFile, CorruptFile: there is no such file, or it cannot be imported.
    """
    before = os.environ.get(VARIABLE)
    files = [str(expanded(path).absolute()) for path in paths]
    if files:
        os.environ[VARIABLE] = os.pathsep.join([*filter(None, [before]), *files])
    try:
        load_plugins()
        yield
    finally:
        if files and before is None:
            del os.environ[VARIABLE]
        elif files and before is not None:
            os.environ[VARIABLE] = before


class Parcel:
    """A function without arguments for another process, of this machine or another: that knows the same plugins before it unpacks it.

    What a plugin defines can be unpacked only where its file was imported, so a parcel holds bytes, and the list of the files.
    """

    def __init__(self, function: Callable[[], Any]) -> None:
        self._listed, self._packed = os.environ.get(VARIABLE, ""), cloudpickle.dumps(function)

    def __call__(self) -> Any:
        """What the function returns. Raises what it raises, and as :func:`added`."""
        load_plugins(self._listed)
        return cloudpickle.loads(self._packed)()


def load_plugins(listed: str | None = None) -> None:
    """Import the files that are ``listed``, else those of :data:`VARIABLE`, each once in a process."""
    listed = os.environ.get(VARIABLE, "") if listed is None else listed
    for name in filter(None, listed.split(os.pathsep)) if listed else ():
        if name not in _loaded:
            _loaded.add(name)  # before it is imported: it looks names up itself
            _import_file(Path(name))


def _import_file(path: Path) -> None:
    if not path.is_file():
        raise MissingFile("plugin", path)
    name = f"marl_handover_plugin_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise CorruptFile("plugin", path, "it is no Python file (.py)")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickle look it up there
    try:
        spec.loader.exec_module(module)
    except HandoverError:
        raise
    except Exception as error:  # whatever the file does
        raise CorruptFile("plugin", path, f"{type(error).__name__}: {first_line(error)}") from error
