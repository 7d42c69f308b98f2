"""The decorator of compiled functions. What numba compiled is kept for the next time where that can be; where not, things run all the same.

numba's own cache decides whether a command runs: it raises where no folder can be written, on a full disk, and on an index that was cut
off or names a module that has moved since.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Literal, TypeVar, overload

from numba import njit
from numba.core.caching import FunctionCache

Function = TypeVar("Function", bound=Callable[..., Any])

_told: list[str] = []
"""What went wrong with the cache; told once a process."""


@overload
def compiled(function: Function) -> Function: ...
@overload
def compiled(*, error_model: Literal["numpy", "python"]) -> Callable[[Function], Function]: ...
def compiled(function: Any = None, *, error_model: Literal["numpy", "python"] = "numpy") -> Any:
    """Compile a function at its first call; it lets other threads run meanwhile.

    Args:
        function: to be compiled.
        error_model: ``"numpy"``: a division by zero is infinite; ``"python"``: it raises.
    """
    if function is None:
        return lambda function: compiled(function, error_model=error_model)  # type: ignore[call-overload]
    dispatcher = njit(nogil=True, error_model=error_model)(function)
    if hasattr(dispatcher, "_cache"):  # else compiling is switched off
        dispatcher._cache = _Cache(function)
    return dispatcher


def cache_place() -> tuple[str, str]:
    """Where compiled functions are kept, and what is wrong with that place; the other one is empty."""
    try:
        cache = FunctionCache(compiled)
        cache._impl.locator.ensure_cache_path()
    except Exception as error:
        return "", _reason(error)
    return str(cache.cache_path), ""


class _Cache:
    """What a dispatcher asks for compiled code and gives it to: numba's cache, whose failures cost time only."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._cache: Any = None

    @property
    def cache_path(self) -> str:
        """See numba."""
        return "" if self._cache is None else str(self._cache.cache_path)

    def enable(self) -> None:
        """See numba."""

    def disable(self) -> None:
        """See numba."""

    def load_overload(self, signature: Any, context: Any) -> Any:
        """The compiled code of a signature; None if it is not there or cannot be read."""
        try:
            if self._cache is None:
                self._cache = FunctionCache(self._function)
            return self._cache.load_overload(signature, context)
        except Exception as error:
            _tell(error)
        try:
            self._cache.flush()  # an index that cannot be read would fail again when the code is saved
        except Exception as error:
            _tell(error)
        return None

    def save_overload(self, signature: Any, code: Any) -> None:
        """Keep compiled code."""
        try:
            if self._cache is not None:
                self._cache.save_overload(signature, code)
        except Exception as error:
            _tell(error)


def _tell(error: Exception) -> None:
    if not _told:
        _told.append(_reason(error))
        print(f"compiled functions cannot be kept for the next time ({_told[0]}); NUMBA_CACHE_DIR=FOLDER says where", file=sys.stderr)


def _reason(error: Exception) -> str:
    """In a line."""
    return " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())[:120]
