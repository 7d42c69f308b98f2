"""Suites of runs: fanned out over cores or a cluster, compared with statistics, searched for better settings."""
