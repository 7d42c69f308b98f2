"""The cell in a browser: play, a trace, a session. Only this folder imports viser; nothing below knows of it."""

from importlib.util import find_spec

from marl_handover.errors import MissingExtra

if find_spec("viser") is None:
    raise MissingExtra("view", "viser", "view")
