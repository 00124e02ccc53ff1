"""Check that the types of the public names are complete: `python .ci/typed.py`."""

import re
import subprocess
import sys

LEAST = 98.0
"""The least percentage of public names with complete types."""


def main() -> int:
    """Print the percentage, and the names without complete types where there are too many; return 1 then."""
    command = ["pyright", "--verifytypes", "sidestep", "--ignoreexternal"]
    report = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    score = re.search(r"Type completeness score: ([\d.]+)%", report)
    complete = float(score[1]) if score else 0.0
    if complete < LEAST:
        print(report)
    print(f"types of public names: {complete} % complete, at least {LEAST} % asked")
    return int(complete < LEAST)


if __name__ == "__main__":
    sys.exit(main())
