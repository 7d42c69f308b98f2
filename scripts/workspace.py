"""The same as ``marl-handover workspace [key=value ...]``."""

import sys

from marl_handover.cli import main

if __name__ == "__main__":
    raise SystemExit(main(["workspace", *sys.argv[1:]]))
