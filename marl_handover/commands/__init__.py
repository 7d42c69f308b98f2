"""One module for each command of ``marl-handover``.

Each offers ``SCHEMA`` (root dataclass of its keys), ``ALIASES`` (short key -> dotted key), ``GROUPS`` (options that are code) and
``run(config) -> int``, the exit status. :mod:`marl_handover.cli` finds and calls them.
"""
