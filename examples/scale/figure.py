"""Draw what maps of growing size cost: docs/scale.svg.

    python examples/scale/figure.py examples/scale/results/cost.csv docs/scale.svg

The table has a row for each size: `intersections`, `median_s`, `refusal_s`, `memory_mb`, `disk_mb`.
"""

import argparse
import csv
import math
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.ticker import LogLocator, NullFormatter

#: Title of each panel, and its lines: column, name and colour.
PANELS = {
    "A mask, seconds of one core": [
        ("median_s", "located (median)", "#0b6e4f"),
        ("refusal_s", "refused (median)", "#c8553d"),
    ],
    "Gigabytes": [
        ("disk_mb", "on disk", "#8d99ae"),
        ("memory_mb", "resident, most", "#2b2d42"),
    ],
}
#: Divisor of a column.
UNITS = {"disk_mb": 1000.0, "memory_mb": 1000.0}


def draw(rows: list[dict[str, str]], target: Path) -> None:
    """Draw a panel for each kind of cost, both axes logarithmic; at a slope of 1 a cost grows as the map does."""
    # Letters stay letters, and the same table gives the same file.
    plt.rcParams.update(
        {"svg.fonttype": "none", "svg.hashsalt": "roadgeo", "font.size": 9, "font.family": "sans-serif"}
    )
    figure, axes = plt.subplots(1, len(PANELS), figsize=(8.0, 3.4), layout="constrained")
    for axis, (title, lines) in zip(axes, PANELS.items(), strict=True):
        for column, name, colour in lines:
            points = [(float(row["intersections"]), float(row[column])) for row in rows if row.get(column)]
            xs, ys = zip(*((x, y / UNITS.get(column, 1.0)) for x, y in points), strict=True)
            axis.plot(xs, ys, "o-", color=colour, label=name, markersize=4)
        axis.set(xscale="log", yscale="log", xlabel="intersections", title=title)
        # The same range of maps in all panels, and only powers of ten are written out.
        sizes = [float(row["intersections"]) for row in rows]
        axis.set_xlim(0.7 * min(sizes), 1.4 * max(sizes))
        for scale in (axis.xaxis, axis.yaxis):
            scale.set_major_locator(LogLocator(10.0))
            scale.set_minor_formatter(NullFormatter())
        low, high = axis.get_ylim()
        axis.set_ylim(10 ** math.floor(math.log10(low)), 10 ** math.ceil(math.log10(high)))
        axis.grid(which="major", color="#dddddd", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False)
    figure.savefig(target, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", type=Path)
    parser.add_argument("figure", type=Path)
    given = parser.parse_args()
    with given.table.open(newline="") as file:
        draw(list(csv.DictReader(file)), given.figure)


if __name__ == "__main__":
    main()
