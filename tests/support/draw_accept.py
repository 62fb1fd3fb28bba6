"""Draw the files of tests/data/accept anew: python tests/support/draw_accept.py (needs ROADGEO_DATA).

The roads are cities of the atlas, moved back to where they lie, without the band across the middle that
`examples/trust/trust.py` leaves out of its maps; masks are drawn as it draws them, by city, kind, seed and number. So a
mask without a place that `trust.py` once found located can be kept: add a line to `CASES` with the reason.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely

ROOT = Path(__file__).parents[2]
OUT = ROOT / "tests" / "data" / "accept"


@dataclass(frozen=True)
class Case:
    """A mask: where it is looked for, how it was drawn, what it must come to, and why it is kept."""

    city: str
    kind: str
    seed: int
    k: int
    why: str
    source: str = ""
    effort: str = "auto"
    view: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        return "_".join([self.city, self.kind, *([self.source] if self.source else []), str(self.seed), str(self.k)])


#: Cities whose roads are not simplified: what an older engine found there it does not find by coarser ones.
EXACT = ("portoalegre",)

FRAME = (("size_px", (1024, 1024)), ("gsd_m", (0.45, 0.55)), ("tilt_deg", (0.0, 5.0)), ("intersections", (12, 10**6)))
CASES = (
    Case("portoalegre", "mirrored", 17, 25, "a quarter of concentric streets, its own mirror image: 10^8"),
    Case("portland", "mirrored", 61, 5, "a grid that lies roughly on its own place, turned over: located at 10^4.7"),
    Case("portland", "mirrored", 74, 0, "a quarter like its mirror image but for a corner: 10^4.5", effort="full"),
    Case("astana", "mirrored", 14, 2, "a motorway junction lay on another one, turned over: located at 10^4.2"),
    Case("astana", "mirrored", 97, 57, "few roads, turned over: the second highest of 3,040 full searches, 10^1.8"),
    Case("campogrande", "mirrored", 97, 15, "turned over: the highest of 3,040 full searches, 10^2.8, full effort"),
    Case("montevideo", "mirrored", 76, 0, "a grid turned over: the highest of 502 full searches, 10^1.3"),
    Case("montevideo", "elsewhere", 16, 0, "a mask of another grid", "portland"),
    Case("chicago", "mirrored", 61, 1, "the grid of Chicago, turned over: the second highest of 1,819 searches"),
    Case("chicago", "forbidden", 13, 6, "ground that was cut out of the map: 3.1 with the odds of one tolerance"),
    Case("chicago", "elsewhere", 16, 7, "few streets of Portland in the lattice of Chicago", "portland"),
    Case("portoalegre", "shuffled", 17, 0, "blocks of the city laid out like none"),
    Case("portland", "forbidden", 61, 0, "ground that was cut out of the map"),
    Case("portoalegre", "there", 17, 0, "mild wear"),
    Case("portland", "there", 61, 1, "noisy, in a grid"),
    Case("astana", "there", 14, 2, "8 to 18 intersections"),
    Case("campogrande", "there", 97, 4, "an outdated map"),
    Case("montevideo", "there", 76, 3, "torn: 30 to 50 % of the roads gone, 10 to 40 % false"),
    Case("montevideo", "frame512", 1, 0, "a frame of 512 m in a grid", view=FRAME),
    Case("chicago", "frame512", 1, 0, "a frame of 512 m in a lattice", view=FRAME),
    Case("montevideo", "mirrored512", 1, 1, "a frame of 512 m in a grid, turned over", view=FRAME),
    Case("chicago", "mirrored512", 1, 1, "a frame of 512 m in a lattice, turned over", view=FRAME),
)


def load_trust() -> Any:
    spec = importlib.util.spec_from_file_location("trust", ROOT / "examples" / "trust" / "trust.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["trust"] = module
    spec.loader.exec_module(module)
    return module


class Atlas:
    """The cities of the atlas as files of their own, in a temporary folder."""

    def __init__(self, data: Path, folder: Path) -> None:
        import geopandas as gpd

        self.roads = gpd.read_parquet(data / "atlas" / "roads_packed_plane.parquet")
        cities = json.loads((data / "atlas" / "cities.json").read_text(encoding="utf-8"))
        self.about = {city["city"]: city for city in cities}
        self.folder = folder

    def file(self, city: str) -> Path:
        path = self.folder / f"{city}.parquet"
        if not path.is_file():
            self.roads[self.roads.city == city].to_parquet(path)
        return path

    def home(self, city: str) -> tuple[str, Any]:
        """Return the CRS whose origin is the city's, and what moves the packed plane there."""
        about = self.about[city]
        crs = f"+proj=aeqd +lat_0={about['lat0']} +lon_0={about['lon0']} +datum=WGS84 +units=m +type=crs"
        return crs, np.array([about["dx"], about["dy"]])


def write_roads(trust: Any, atlas: Atlas, city: str) -> None:
    """Write the roads outside the band, to the decimetre."""
    import geopandas as gpd

    found = trust.read_roads(atlas.file(city))
    _, outside = trust.split(found)
    crs, offset = atlas.home(city)
    lines = shapely.transform(outside, lambda xy: xy + found.plane.origin - offset)
    lines = lines if city in EXACT else shapely.simplify(lines, 0.3)
    lines = shapely.transform(lines, lambda xy: np.round(xy, 1))
    frame = gpd.GeoDataFrame(geometry=lines[shapely.length(lines) > 0], crs=crs)
    frame.to_parquet(OUT / f"{city}.parquet", compression="zstd", compression_level=19)


def draw(trust: Any, atlas: Atlas, case: Case) -> dict[str, Any]:
    """Draw and write a mask; return its entry in `cases.json`, with its homography to the CRS of the city's roads."""
    known, other = (trust.City(name, atlas.file(name), Path()) for name in (case.city, case.source or case.city))
    if case.view:
        outside, _ = trust.landscapes(known.roads)
        view, noise = replace(trust.VIEW, **dict(case.view)), trust.MILD
        options = trust.SimulationOptions(view, noise, case.kind, case.seed, case.kind.startswith("mirrored"))
        query = trust.simulate_query(outside, options, case.k)
        truth, mask = replace(query.truth, on_map=not options.mirrored), query.mask
    else:
        truth, mask = trust.Searched(known, other, case.kind, case.seed, case.k + 1).open()(case.k)
    cv2.imwrite(
        str(OUT / "masks" / f"{case.name}.png"), mask, [cv2.IMWRITE_PNG_BILEVEL, 1, cv2.IMWRITE_PNG_COMPRESSION, 9]
    )
    _, offset = atlas.home(case.city)
    home = np.array([[1, 0, -offset[0]], [0, 1, -offset[1]], [0, 0, 1]]) @ truth.homography
    return {
        "mask": f"{case.name}.png",
        "city": case.city,
        "effort": case.effort,
        "why": case.why,
        "homography": (home / home[2, 2]).tolist() if truth.on_map else None,
    }


def main() -> None:
    trust = load_trust()
    with tempfile.TemporaryDirectory() as folder:
        atlas = Atlas(Path(os.environ["ROADGEO_DATA"]), Path(folder))
        (OUT / "masks").mkdir(parents=True, exist_ok=True)
        for city in sorted({case.city for case in CASES}):
            write_roads(trust, atlas, city)
        entries = [draw(trust, atlas, case) for case in CASES]
    (OUT / "cases.json").write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
