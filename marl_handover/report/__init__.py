"""Figures. The only part of the package that imports matplotlib, and only through ``Figure`` objects: no windows, no global state."""
