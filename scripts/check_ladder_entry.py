"""Check entries of the ladder: ``python scripts/check_ladder_entry.py FOLDER ...``.

Each FOLDER holds RUNG.json and RUNG.jsonl, a report and its trace, of one rung or more. The traces are replayed by the rule book.
"""

import sys
from pathlib import Path

from marl_handover.errors import HandoverError, MissingFile, counted
from marl_handover.experiments.ladder_entry import check_entry

if __name__ == "__main__":
    try:
        for folder in map(Path, sys.argv[1:]):
            reports = sorted(folder.glob("*.json"))
            if not reports:
                raise MissingFile("report", folder / "RUNG.json")
            for report in reports:
                found = check_entry(report, report.with_suffix(".jsonl"))
                problems = counted(len(found.regret), "problem")
                print(f"{report}: {problems} replayed, regret {found.regret.mean():.4f}, solved {100 * found.solved.mean():.2f} %")
    except HandoverError as error:
        sys.exit(str(error))
