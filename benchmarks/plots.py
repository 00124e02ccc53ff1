"""Pictures of benchmark records: time and peak memory against the number of cells.

    python benchmarks/plots.py scaling.json --out docs/images/scaling.png

A panel of times for each backup, a line for each method; solid from nothing, dashed after an optimiser's step. Where
records have it, a dotted line shows one shortest-path search on the same map, the unit. The last panel shows memory.
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
Styles = Mapping[str, Mapping[str, Any]]
MARKERS = "os^Dv<>PX*hpd8"


def lines(records: Sequence[Record], field: str) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Name, cells and values of each method and backup that has values in a field, in the order of the records."""
    for kind in dict.fromkeys((record["name"], record["backup"]) for record in records):
        own = [record for record in records if (record["name"], record["backup"]) == kind]
        found = sorted((record["cells"], record[field]) for record in own if record.get(field) is not None)
        if found:
            cells, values = np.array(found, dtype=float).T
            yield kind[0], cells, values


def styles(records: Sequence[Record]) -> Styles:
    """A colour and a marker for each method, the same in all panels."""
    names = dict.fromkeys(record["name"] for record in records)
    return {
        name: {"color": f"C{number}", "marker": MARKERS[number % len(MARKERS)]} for number, name in enumerate(names)
    }


def draw_times(axes: Axes, records: Sequence[Record], style: Styles) -> None:
    """Seconds from nothing and after a step, and those of the unit; all records of one backup."""
    for name, cells, seconds in lines(records, "cold_seconds"):
        axes.plot(cells, seconds, label=name, **style[name])
    for name, cells, seconds in lines(records, "warm_seconds"):
        axes.plot(cells, seconds, "--", markerfacecolor="white", **style[name])
    for _, cells, seconds in list(lines(records, "dijkstra_seconds"))[:1]:
        axes.plot(cells, seconds, "k:", label="one shortest-path search")
    axes.set(xscale="log", yscale="log", xlabel="cells", ylabel="seconds (dashed: after a step)")
    axes.set_title(records[0]["backup"], fontsize="medium")


def draw_memory(axes: Axes, records: Sequence[Record], style: Styles) -> None:
    """The processes' peaks."""
    for name, cells, peak in lines(records, "peak_bytes"):
        axes.plot(cells, peak / 2**20, **style[name])
    axes.set(xscale="log", ylim=(0, None), xlabel="cells", ylabel="peak memory of the process (MiB)")


def main() -> int:
    """Draws what the arguments ask for."""
    parser = argparse.ArgumentParser(description="Pictures of benchmark records.")
    parser.add_argument("records", type=Path, help="what a benchmark has written with --json")
    parser.add_argument("--out", type=Path, required=True, metavar="PICTURE.png")
    arguments = parser.parse_args()
    records = json.loads(arguments.records.read_text())["records"]
    backups, style = list(dict.fromkeys(record["backup"] for record in records)), styles(records)
    figure, panels = plt.subplots(1, len(backups) + 1, figsize=(4.2 * (len(backups) + 1), 5), layout="constrained")
    for axes, backup in zip(panels, backups, strict=False):
        draw_times(axes, [record for record in records if record["backup"] == backup], style)
    draw_memory(panels[-1], records, style)
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.3)
    handles = {label: line for axes in panels for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=5, fontsize="small", frameon=False
    )
    figure.savefig(arguments.out, dpi=120)
    return 0


if __name__ == "__main__":
    sys.exit(main())
