"""Compare the numbers of two versions: `demo`, `reproduce`, `learn` on the twelve mazes, and the depot.

    python .ci/same_numbers.py run DIR            # with the version that is installed
    python .ci/same_numbers.py compare DIR OTHER  # the numbers of both, key by key

`run` calls the command line. `compare` reads every `blocked.npy` and JSON file in both folders.
Keys that changed their names are in `RENAMED`; times and memory are left out. This file goes when the issue ends.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

SHARED = Path(__file__).parents[2] / "shared" / "data"
LEFT_OUT = {
    "seconds", "peak_memory_bytes", "files", "settings", "command", "true_map", "truth", "message", "walkers", "agents",
    "status", "connectivity", "cold_seconds", "peak_bytes", "machine", "planned_at_most", "sensor",
}  # fmt: skip
RENAMED = {
    "lapses": "lapse",
    "legal_share": "legal_fraction",
    "arriving_share": "arriving_fraction",
    "effective_share": "effective_sample_ratio",
}


def run(folder: Path) -> None:
    """Run the commands with the installed version; a run that is there already is kept."""
    mazes = {maze.name: maze for maze in sorted((SHARED / "tartarus").glob("maze_*"))}
    commands = {"demo": ["demo", "--seed", "0"], "reproduce": ["reproduce", "--seed", "0"]}
    for name, maze in mazes.items():
        commands[name] = ["learn", str(maze / "humans.csv"), "--map", str(maze / "blank.yaml"), "--seed", "0"]
    for name, command in commands.items():
        if not (folder / name / "summary.json").exists():
            subprocess.run(["sidestep", *command, "--out", str(folder / name)], check=True)
        if name in mazes:
            truth = str(mazes[name] / "truth.yaml")
            subprocess.run(["sidestep", "evaluate", str(folder / name), "--truth", truth], check=True)
    depot = [
        "-m",
        "benchmarks",
        "fits",
        "--maps",
        str(SHARED / "maps" / "depot.yaml"),
        "--json",
        str(folder / "depot.json"),
    ]
    subprocess.run([sys.executable, *depot], check=True)


def numbers(value: Any, path: str = "") -> dict[str, float]:
    """Return all numbers below a JSON value by their path, under the present names of keys."""
    if isinstance(value, dict):
        items = [(RENAMED.get(key, key), each) for key, each in value.items() if key not in LEFT_OUT]
    elif isinstance(value, list):
        items = list(enumerate(value))
    else:
        return {path: float(value)} if isinstance(value, int | float) else {}
    return {name: number for key, each in items for name, number in numbers(each, f"{path}/{key}").items()}


def compare(folder: Path, other: Path) -> int:
    """Print the largest difference of every file, and return how many files differ."""
    differing = 0
    for file in sorted({each.relative_to(folder) for kind in ("*.json", "blocked.npy") for each in folder.rglob(kind)}):
        if not (other / file).exists():
            continue
        if file.suffix == ".npy":
            one, two = np.load(folder / file), np.load(other / file)
            count, largest, missing = one.size, float(np.abs(one - two).max()), []
        else:
            one, two = (numbers(json.loads((root / file).read_text())) for root in (folder, other))
            shared = sorted(set(one) & set(two))
            missing = sorted(set(one) ^ set(two))
            differences = [abs(one[key] - two[key]) / max(1.0, abs(one[key])) for key in shared]
            count, largest = len(shared), max(differences, default=0.0)
        differing += largest > 0
        print(
            f"{file}: {count} numbers, largest difference {largest:.2g}",
            *(["only in one:", *missing] if missing else []),
        )
    print(f"{differing} files differ")
    return differing


if __name__ == "__main__":
    if sys.argv[1] == "run":
        run(Path(sys.argv[2]))
    else:
        compare(Path(sys.argv[2]), Path(sys.argv[3]))
