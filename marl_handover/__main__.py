"""``python -m marl_handover``: the command line."""

from marl_handover.cli import main

raise SystemExit(main())
