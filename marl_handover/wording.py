"""Numbers in sentences. Signed numbers are written with ``z`` in their format, so that there is no minus before 0."""

from __future__ import annotations


def counted(count: int, what: str) -> str:
    """``1 transfer``, ``2 transfers``."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"
