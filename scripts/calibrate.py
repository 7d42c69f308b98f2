"""The same as ``marl-handover calibrate [key=value ...]``."""

import sys

from marl_handover.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["calibrate", *sys.argv[1:]]))
