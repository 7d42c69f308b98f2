"""Modules that only Unix has, out of the way as on Windows: commands that do not need them work all the same."""

from __future__ import annotations

import subprocess
import sys

import pytest

from marl_handover import cli

UNIX_ONLY = ("fcntl", "termios", "tty", "pty")
MOVE_NOTHING = (
    ["doctor"],
    ["plan", "start=[-100,50,10]", "goal=[80,-40,120]"],
    ["evaluate", "policy=pretrained_b", "episodes=20", "progress=false"],
)
CODE = f"""
import sys, warnings
warnings.simplefilter("ignore")  # filelock tells that it locks in another way
sys.modules.update(dict.fromkeys({UNIX_ONLY!r}))
from marl_handover import cli
for arguments in [[name, "--help"] for name in cli.COMMANDS] + {list(MOVE_NOTHING)!r}:
    print("STATUS", arguments[0], cli.main(arguments))
print("STATUS", "emulate", cli.main(["emulate", "link=" + sys.argv[1]]))
"""


@pytest.mark.slow
def test_commands_need_none_of_them_unless_they_open_a_terminal(tmp_path):
    done = subprocess.run([sys.executable, "-c", CODE, str(tmp_path / "port")], capture_output=True, text=True, timeout=300)
    statuses = [tuple(line.split()[1:]) for line in done.stdout.splitlines() if line.startswith("STATUS")]
    fine = [(name, "0") for name in cli.COMMANDS] + [(arguments[0], "0") for arguments in MOVE_NOTHING]
    assert statuses == [*fine, ("emulate", "1")], done.stderr
    assert done.stderr.splitlines()[-1].startswith("marl-handover emulate: emulate needs pseudo-terminals")
