"""The shape of true maps: weights of a binary Markov random field for each kind of map, and for banks of maps.

    python -m benchmarks shapes
    python -m benchmarks shapes --terms lines blocks --standard-deviation 5
    python -m benchmarks shapes --separate-fields

By maximum pseudo-likelihood (`sidestep.inference.pseudolikelihood`). η is the density: the log-odds of a cell where no
shape term counts (with `--separate-fields` each map has its own, and the table their mean). Kinds of map:

- `mazes 1–6` of Tartarus, for development, and `mazes 7–12`, which are for judging only;
- `offices`, `apartments` and `blocks`, drawn by seed (`sidestep.worlds`);
- Nav2's `depot` and `warehouse`, on coarser cells, each as dark as its darkest fine one;
- `development`: the bank of all maps but mazes 7–12, and `kinds alike`: the same, repeated until all kinds have about
  as many cells.

Records: `kind`, `maps`, `cells`, `occupied` (the fraction), `field`, `lines`, `pairs`, `blocks`, `isolated`,
`log_pseudolikelihood` (the mean over cells, in nats), and `independent`, the same for cells without a shape.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import SHARED_DATA, Record, option, print_table
from benchmarks.domains import DOMAINS
from sidestep.inference.mrf import SHAPE_TERMS
from sidestep.inference.pseudolikelihood import fit_mrf
from sidestep.io.maps import read_map
from sidestep.tabular.grid import Cell, Grid

JUDGED = "mazes 7–12"


@dataclass
class Options:
    """The options of this benchmark."""

    data: Path = option(SHARED_DATA / "tartarus", "maze_*/ with maps")
    maps: list[Path] = option([SHARED_DATA / "maps" / f"{name}.yaml" for name in ("depot", "warehouse")], "maps")
    side: float = option(0.4, "metres, about the side of a cell of these maps")
    count: int = option(20, "maps of each simulated domain", quick=4)
    first: int = option(100, "the seed of the first of them", least=0)
    rows: int = option(20, "of each of them")
    columns: int = option(30, "of each of them")
    terms: list[str] = option(list(SHAPE_TERMS), "shape terms", choices=SHAPE_TERMS)
    separate_fields: bool = option(False, "a density for each map")
    standard_deviation: float = option(3.0, "of the normal prior of each weight, in nats")


def kinds_of_maps(options: Options) -> dict[str, list[Grid]]:
    """Return the maps of each kind by its name."""
    mazes = [read_map(path) for path in sorted(options.data.glob("maze_*/truth.yaml"))]
    seeds = range(options.first, options.first + options.count)
    drawn = {name: [draw(options.rows, options.columns, seed) for seed in seeds] for name, draw in DOMAINS.items()}
    kinds = {"mazes 1–6": mazes[:6], JUDGED: mazes[6:], **drawn}
    for path in options.maps:
        grid = read_map(path)
        kinds[path.stem] = [coarsened(grid, max(1, round(options.side / grid.resolution)))]
    return {name: maps for name, maps in kinds.items() if maps}


def coarsened(grid: Grid, factor: int) -> Grid:
    """Return a map on squares of `factor` × `factor` cells: occupied if one of them is, else unknown if most are.

    Rows at the top and columns at the right that fill no square are left out.
    """
    rows, columns = (side // factor for side in grid.shape)
    squares = grid.known[grid.shape[0] - rows * factor :, : columns * factor]
    squares = squares.reshape(rows, factor, columns, factor)
    unknown = (squares == Cell.UNKNOWN).mean(axis=(1, 3)) > 0.5
    known = np.where(unknown, int(Cell.UNKNOWN), int(Cell.FREE))
    known[(squares == Cell.OCCUPIED).any(axis=(1, 3))] = Cell.OCCUPIED
    return replace(grid, known=known, resolution=grid.resolution * factor)


def banks(kinds: Mapping[str, Sequence[Grid]]) -> dict[str, list[Grid]]:
    """Return the maps of all kinds but the judged one together, and the same with each kind repeated."""
    cells = {name: sum(grid.size for grid in maps) for name, maps in kinds.items() if name != JUDGED}
    repeats = {name: max(1, round(max(cells.values()) / size)) for name, size in cells.items()}
    return {
        "development": [grid for name in cells for grid in kinds[name]],
        "kinds alike": [grid for name in cells for grid in repeats[name] * list(kinds[name])],
    }


def measure(options: Options) -> Iterator[Record]:
    """Yield a record for each kind of map and each bank."""
    kinds = kinds_of_maps(options)
    prior = {"standard_deviation": options.standard_deviation, "separate_fields": options.separate_fields}
    for name, maps in (kinds | banks(kinds)).items():
        fit, independent = (fit_mrf(maps, terms, **prior) for terms in (options.terms, []))
        occupied = np.concatenate([grid.known[grid.known != Cell.UNKNOWN] for grid in maps]).mean()
        yield {
            "kind": name,
            "maps": len(maps),
            "cells": fit.cells,
            "occupied": float(occupied),
            "field": float(fit.field.mean()),
            **{term: getattr(fit, term) for term in SHAPE_TERMS},
            "log_pseudolikelihood": fit.log_pseudolikelihood,
            "independent": independent.log_pseudolikelihood,
        }


def show(records: Sequence[Record], options: Options) -> None:
    """Print the table."""
    columns = {"maps": "kind", "number": "maps", "cells": "cells", "occupied": "occupied .3f", "η": "field .2f"}
    columns |= {term: f"{term} .2f" for term in options.terms}
    columns |= {"nats a cell": "log_pseudolikelihood .3f", "without a shape": "independent .3f"}
    fields = "a density for each map" if options.separate_fields else "one density"
    print_table(f"pseudo-likelihood, {fields}, σ = {options.standard_deviation:g}", records, columns)
