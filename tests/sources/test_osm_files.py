"""OpenStreetMap files of every shape give the same streets."""

import gzip
import time
from pathlib import Path

import pytest
import shapely
from worlds.fenway import elements, streets
from worlds.osm_files import o5m, osm_texts, overpass_answers

from roadgeo.errors import RoadSourceError
from roadgeo.sources.osm_files import _deleted_ways
from roadgeo.sources.roads import read_roads
from roadgeo.sources.streams import read_lines


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system does not tell what files are open")
def test_a_damaged_header_leaves_no_file_open(tmp_path: Path) -> None:
    path = tmp_path / "roads.osm.pbf"
    header = b"\x0a\x09OSMHeader\x18\x07"
    path.write_bytes(len(header).to_bytes(4, "big") + header + b"\x0a\x05\x0a\x04abc")
    counts = []
    for _ in range(4):
        with pytest.raises(RoadSourceError):
            read_roads(path)
        counts.append(len(list(Path("/proc/self/fd").iterdir())))
    assert counts[1] == counts[-1]


# --- files of every shape ---------------------------------------------------------------------------------------------


def right() -> tuple[list[bytes], list[str]]:
    lines, highway, _ = streets()
    found = sorted(zip(shapely.to_wkb(shapely.set_precision(lines, 1e-6)), highway, strict=True))
    return [line for line, _ in found], [kind for _, kind in found]


def read(path: Path) -> tuple[list[bytes], list[str]]:
    found = read_lines(path)
    shapes = shapely.to_wkb(shapely.set_precision(found.lines, 1e-6))
    pairs = sorted(zip(shapes, found.highway, strict=True))
    return [line for line, _ in pairs], [kind for _, kind in pairs]


@pytest.mark.parametrize("what", osm_texts())
@pytest.mark.parametrize("ending", [".osm", ".osm.gz", ".osh"])
def test_files_of_every_shape_give_the_same_streets(tmp_path: Path, what: str, ending: str) -> None:
    path, content = tmp_path / f"roads{ending}", osm_texts()[what].encode()
    path.write_bytes(gzip.compress(content) if ending.endswith("gz") else content)
    assert read(path) == right()


@pytest.mark.parametrize(
    "what", [osm_text for osm_text in osm_texts() if osm_text not in ("deleted in JOSM", "places without ids")]
)
def test_pbf_files_of_every_shape(tmp_path: Path, what: str) -> None:
    import osmium

    path = tmp_path / ("roads.osh.pbf" if what.startswith(("history", "no longer", "deleted")) else "roads.osm.pbf")
    low = ",locations_on_ways=true" if what == "places in ways" else ""
    file = osmium.io.File(str(path), f"osh.pbf{low}" if ".osh" in path.name else f"pbf{low}")
    with osmium.SimpleWriter(file) as writer:
        for entity in osmium.FileProcessor(osmium.io.FileBuffer(osm_texts()[what].encode(), "osm")):
            writer.add(entity)
    assert read(path) == right()


def test_o5m(tmp_path: Path) -> None:
    (tmp_path / "roads.o5m").write_bytes(o5m())
    assert read(tmp_path / "roads.o5m") == right()


@pytest.mark.parametrize("what", overpass_answers())
def test_answers_of_overpass(tmp_path: Path, what: str) -> None:
    path = tmp_path / "roads.json"
    path.write_text(overpass_answers()[what])
    assert read(path) == right()


def test_ways_without_places_are_counted_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "roads.osm"
    ways = osm_texts()["nodes first"].splitlines()
    path.write_text("\n".join(row for row in ways if not row.startswith("<node")))
    with pytest.raises(RoadSourceError, match="the nodes of its ways are not in it: export them too"):
        read_roads(path)
    lost = set(elements()[1][0]["nodes"])
    path.write_text("\n".join(row for row in ways if not any(f'<node id="{n}"' in row for n in lost)))
    read_roads(path)
    assert "are ways whose nodes are not in the file" in caplog.text


@pytest.mark.parametrize("text", ['{"elements": 3}', '{"elements": [3, {"type": "way"}]}', '{"elements": [', "{}"])
def test_other_answers_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(RoadSourceError, match=r"a\.json"):
        read_roads(tmp_path / "a.json")


@pytest.mark.parametrize(
    "content",
    [
        b"<osm><remark>" + b" " * 1_000_000,
        b"<remark> " * 100_000,
        b"delete" + b"<way " * 200_000,
        b"<way action='delete' " * 50_000,
    ],
    ids=["blanks", "remarks", "ways", "deleted"],
)
def test_what_has_no_end_is_looked_at_once(content: bytes, tmp_path: Path) -> None:
    """Squares of the size: 10 kB of blanks took 40 s."""
    (tmp_path / "a.osm").write_bytes(content)
    started = time.process_time()
    assert _deleted_ways(tmp_path / "a.osm") == set()
    assert time.process_time() - started < 1.0
