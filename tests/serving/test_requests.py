"""What is asked of the server, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.exceptions import HTTPException

from roadgeo.serving.requests import ending_of, read_hints, read_query_string


@pytest.mark.parametrize(
    ("head", "ending"),
    [
        (b"\x89PNG\r\n\x1a\n....", ".png"),
        (b"\xff\xd8\xff\xe0", ".jpg"),
        (b"II*\0....", ".tif"),
        (b"RIFF....WEBP", ".webp"),
    ],
)
def test_images_are_known_by_how_they_begin(head, ending):
    assert ending_of(head) == ending


@pytest.mark.parametrize("head", [b"", b"<VRTDataset", b"PK\x03\x04", b"\x93NUMPY\x01", b"RIFF....AVI ", b"#!/bin/sh"])
def test_what_may_refer_to_other_files_is_refused(head):
    with pytest.raises(HTTPException) as refused:
        ending_of(head)
    assert refused.value.status_code == 415


@pytest.mark.parametrize("head", [b"\0\0\0\x18ftypheic", b"\0\0\0\x1cftypavif", b"\0\0\0\x20ftypisom"])
def test_pictures_of_phones_and_videos_are_named(head):
    with pytest.raises(HTTPException) as refused:
        ending_of(head)
    assert "in HEIC or AVIF, or a video, which are not read: save a picture as JPEG" in refused.value.detail


def test_hints_come_from_the_url():
    found = read_query_string(
        "near=-71.06,42.36,5000&within=-73,41,-70,43&gsd=0.3,0.6&maxTilt=20&focal=900&northUp=true&timeLimit=3"
    )
    assert found == {
        "near": (-71.06, 42.36, 5000.0), "within": (-73.0, 41.0, -70.0, 43.0),
        "gsd_m": (0.3, 0.6), "max_tilt_deg": 20.0, "focal_px": 900.0,
        "north_up": True, "time_limit_s": 3.0,
    }  # fmt: skip
    assert read_query_string("") == {}


def test_points_have_column_row_longitude_and_latitude():
    points = read_query_string("points=1,2,8.5,47,30,2,8.6,47,1,40,8.5,47.1")["points"]
    assert points == ((1.0, 2.0, 8.5, 47.0), (30.0, 2.0, 8.6, 47.0), (1.0, 40.0, 8.5, 47.1))


@pytest.mark.parametrize(
    "text",
    ["points=1,2,8.5,47,30,2,8.6,47", "points=1,2,8.5,97,30,2,8.6,47,1,40,8.5,47.1",
     "near=1,2", "near=200,0,5", "within=1,2,3", "within=1,3,2,3",
     "gsd=2,1", "gsd=nan,1", "maxTilt=x", "maxTilt=inf", "colour=red", "a;b", "near",
     "&".join(f"a{k}=1" for k in range(50))],
)  # fmt: skip
def test_other_urls_are_refused(text):
    with pytest.raises(HTTPException) as refused:
        read_query_string(text)
    assert refused.value.status_code == 400


def test_a_flag_is_no_number():
    with pytest.raises(HTTPException):
        read_hints([("focal", True)])
    with pytest.raises(HTTPException):
        read_hints([("northUp", 1)])


HINTS = st.sampled_from(["near", "gsd", "maxTilt", "focal", "northUp", "timeLimit", "colour"])
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda item: st.lists(item, max_size=4),
)


@given(st.dictionaries(HINTS, VALUES, max_size=4))
def test_any_hints_are_finite_numbers_or_refused(values):
    try:
        found = read_hints(values.items())
    except HTTPException:
        return
    for value in found.values():
        assert value is True or value is False or np.isfinite(value).all()


def test_a_place_to_take_is_a_whole_number_from_1():
    assert read_query_string("take=2") == {"take": 2}
    for text in ("take=0", "take=1.5", "take=x", "take=1e9", "take=nan"):
        with pytest.raises(HTTPException, match="take: got"):
            read_query_string(text)


def test_a_hint_that_is_given_twice_is_refused():
    with pytest.raises(HTTPException, match="gsd is given twice") as refused:
        read_query_string("gsd=0.3&near=1,2,500&gsd=0.5")
    assert refused.value.status_code == 400
