"""Pictures of benchmark records: time and peak memory against the number of cells.

    python benchmarks/plots.py scaling.json --out docs/images/scaling.png

A line is a method and its backup; solid from nothing, dashed after an optimiser's step. Where records have it, a dotted
line shows one shortest-path search on the same map, the unit.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

Record = Mapping[str, Any]
MARKERS = "os^Dv<>PX*"


def label_of(record: Record) -> str:
    """What a line is called."""
    return f"{record['name']}, {record['backup']}"


def lines(records: Sequence[Record], field: str) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Label, cells and values of each method that has values in a field, in the order of the records."""
    for label in dict.fromkeys(map(label_of, records)):
        own = [record for record in records if label_of(record) == label and record.get(field) is not None]
        found = sorted((record["cells"], record[field]) for record in own)
        if found:
            cells, values = np.array(found, dtype=float).T
            yield label, cells, values


def styles(records: Sequence[Record]) -> dict[str, dict[str, Any]]:
    """A colour and a marker for each method, the same in all panels."""
    labels = dict.fromkeys(map(label_of, records))
    return {
        label: {"color": f"C{number}", "marker": MARKERS[number % len(MARKERS)]} for number, label in enumerate(labels)
    }


def draw_times(axes: Axes, records: Sequence[Record]) -> None:
    """Seconds from nothing and after a step, and those of the unit."""
    style = styles(records)
    for label, cells, seconds in lines(records, "cold_seconds"):
        axes.plot(cells, seconds, label=label, **style[label])
    for label, cells, seconds in lines(records, "warm_seconds"):
        axes.plot(cells, seconds, "--", markerfacecolor="white", **style[label])
    for _, cells, seconds in list(lines(records, "dijkstra_seconds"))[:1]:
        axes.plot(cells, seconds, "k:", label="one shortest-path search")
    axes.set(xscale="log", yscale="log", xlabel="cells", ylabel="seconds (dashed: after a step)")


def draw_memory(axes: Axes, records: Sequence[Record]) -> None:
    """The processes' peaks."""
    style = styles(records)
    for label, cells, peak in lines(records, "peak_bytes"):
        axes.plot(cells, peak / 2**20, label=label, **style[label])
    axes.set(xscale="log", ylim=(0, None), xlabel="cells", ylabel="peak memory of the process (MiB)")


def main() -> int:
    """Draws what the arguments ask for."""
    parser = argparse.ArgumentParser(description="Pictures of benchmark records.")
    parser.add_argument("records", type=Path, help="what a benchmark has written with --json")
    parser.add_argument("--out", type=Path, required=True, metavar="PICTURE.png")
    arguments = parser.parse_args()
    records = json.loads(arguments.records.read_text())["records"]
    figure, (times, memory) = plt.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
    draw_times(times, records)
    draw_memory(memory, records)
    times.legend(fontsize="small", frameon=False)
    for axes in (times, memory):
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3)
    figure.savefig(arguments.out, dpi=150)
    return 0


if __name__ == "__main__":
    sys.exit(main())
