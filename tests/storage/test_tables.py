"""Tables that people keep: as any program writes them."""

import csv
import io
from pathlib import Path

import numpy as np
import pytest

from roadgeo.errors import RoadSourceError
from roadgeo.evaluation.truth import Truth, read_truth, write_truth
from roadgeo.flights.motion import read_motion

MOTION = np.array([[0.99, 0.01, -3.5], [-0.01, 0.99, 1.25e-3], [1e-5, 0.0, 1.0]])


def motions(folder: Path) -> Path:
    names = ["frame", *(f"h{i}{j}" for i in range(3) for j in range(3))]
    rows = [",".join([name, *map(repr, MOTION.ravel().tolist())]) for name in ("a.png", "b.png")]
    (folder / "motion.csv").write_text("\n".join([",".join(names), *rows]) + "\n")
    return folder / "motion.csv"


def truths(folder: Path) -> Path:
    write_truth(folder, [Truth("a.png", "mask", MOTION, "EPSG:32619", (400, 300), True, {"gsd_m": 0.5})])
    return folder / "truth.csv"


#: Each reader of tables, and what it reads of one.
READERS = {
    "motions": (motions, lambda path: list(read_motion(path).values())),
    "truths": (truths, lambda path: [truth.homography for truth in read_truth(path)]),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("separator", [",", ";", "\t", "; and decimal commas"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("reader", READERS)
def test_tables_are_read_as_any_program_writes_them(
    tmp_path: Path, reader: str, line_end: str, separator: str, encoding: str
) -> None:
    write, read = READERS[reader]
    path = write(tmp_path)
    right, rows = read(path), list(csv.reader(io.StringIO(path.read_text())))
    if "decimal" in separator:
        rows = [[cell if "png" in cell else cell.replace(".", ",") for cell in row] for row in rows]
    text = io.StringIO()
    csv.writer(text, delimiter=separator[0], lineterminator=line_end).writerows(rows)
    path.write_bytes(text.getvalue().encode(encoding))
    np.testing.assert_array_equal(read(path), right)


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\0", b"a;b\n1;2\n", b"\x80abc"])
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_table_is_refused_in_a_line(tmp_path: Path, reader: str, content: bytes) -> None:
    write, read = READERS[reader]
    path = write(tmp_path)
    path.write_bytes(content)
    if not content and reader == "truths":
        assert read(path) == []
        return
    with pytest.raises(RoadSourceError, match="expected") as raised:
        read(path)
    assert "\n" not in str(raised.value)
