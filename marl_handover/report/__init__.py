"""Figures. The only part of the package that imports matplotlib, and only through ``Figure`` objects: no windows, no global state."""

import os
import sys
from unittest import mock

# A shell inside a notebook hands down MPLBACKEND, which names a module that may not be there. Figures that become files need none.
if "matplotlib" not in sys.modules:
    with mock.patch.dict(os.environ, {"MPLBACKEND": "agg"}):
        import matplotlib  # noqa: F401
