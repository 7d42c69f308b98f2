"""Make the ladder's files of problems: ``python scripts/ladder_problems.py [RUNG ...]``, all rungs unless some are named.

Prints the SHA-256 of each, which configs/ladder/rungs.yaml has to say. A file that changes gets an id with the next number there.
"""

import hashlib
import sys

from marl_handover.errors import HandoverError
from marl_handover.files import write_whole
from marl_handover.task.ladder import rung, rungs

if __name__ == "__main__":
    try:
        for each in [rung(name) for name in sys.argv[1:]] or rungs():
            text = each.file_text()
            write_whole(each.path, text)
            print(f"{each.name}: {hashlib.sha256(text.encode()).hexdigest()}", flush=True)
    except HandoverError as error:
        sys.exit(str(error))
