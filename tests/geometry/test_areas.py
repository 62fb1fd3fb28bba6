"""Areas by their names and by their bounds."""

import pytest

from roadgeo.geometry import areas
from roadgeo.geometry.areas import find_area, lies_in, overlap

PORTO, SALT_LAKE_CITY, AUCKLAND, TIFLIS = (-8.6, 41.15), (-111.9, 40.76), (174.76, -36.85), (44.8, 41.7)


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("Portugal", PORTO),
        (" PORTUGAL ", PORTO),
        ("Utah", SALT_LAKE_CITY),
        ("usa - utah", SALT_LAKE_CITY),
        ("USA", SALT_LAKE_CITY),
        ("New Zealand", AUCKLAND),
        ("Georgia", TIFLIS),
        ("-9,41,-8,42", PORTO),
        ("-9, 41, -8, 42", PORTO),
        ("Europe - 12°W to 6°W and ETRS89 by country", PORTO),
        ("170,-40,-170,-30", AUCKLAND),
    ],
)
def test_an_area_is_found_by_its_name_or_its_bounds(name, place):
    box = find_area(name)
    assert [item for item in (PORTO, SALT_LAKE_CITY, AUCKLAND, TIFLIS) if lies_in(box, *item)] == [place]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Germny", "did you mean 'Germany'"),
        ("Atlantis", "no country or state is called 'Atlantis'; give WEST,SOUTH,EAST,NORTH"),
        ("", "expected WEST"),
        ("1,2,3", "got '1,2,3'"),
        ("1,2,3,x", "got '1,2,3,x'"),
        ("Germny 12", "give WEST,SOUTH"),
        ("1,5,3,4", "south below north"),
        ("1,2,1,4", "south below north"),
        ("nan,2,3,4", "south below north"),
        ("170,2,190,4", "south below north"),
    ],
)
def test_what_is_no_area_is_refused(name, said):
    with pytest.raises(ValueError, match=said):
        find_area(name)


@pytest.mark.parametrize(
    ("first", "other", "they_do"),
    [
        ((0, 0, 2, 2), (1, 1, 3, 3), True),
        ((0, 0, 2, 2), (2, 2, 3, 3), True),
        ((0, 0, 2, 2), (2.1, 0, 3, 2), False),
        ((0, 0, 2, 2), (0, 2.1, 2, 3), False),
        ((170, 0, -170, 2), (-175, 0, -174, 2), True),
        ((170, 0, -170, 2), (175, 0, 176, 2), True),
        ((170, 0, -170, 2), (0, 0, 1, 2), False),
        ((170, 0, -170, 2), (179, 0, -179, 2), True),
        ((-180, -90, 180, 90), (170, 0, -170, 2), True),
    ],
)
def test_boxes_share_ground_across_the_antimeridian_too(first, other, they_do):
    assert overlap(first, other) == overlap(other, first) == they_do


def test_without_projs_database_names_are_refused_and_bounds_are_not(tmp_path, monkeypatch):
    monkeypatch.setattr("pyproj.datadir.get_data_dir", lambda: str(tmp_path))
    areas._extents.cache_clear()
    for content in (None, b"no database at all"):
        if content is not None:
            (tmp_path / "proj.db").write_bytes(content)
        with pytest.raises(ValueError, match=r"areas have no names here.*give WEST"):
            find_area("Portugal")
    assert find_area("1,2,3,4") == (1.0, 2.0, 3.0, 4.0)
    areas._extents.cache_clear()
