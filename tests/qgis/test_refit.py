"""The fit of the panel of matches, without QGIS."""

import cv2
import numpy as np
import pytest

from roadgeo.qgis.plugin.refit import TiePoint, fit, format_points, place, read_points, rms

TRUTH = np.array([[1.1, 0.2, 330_000.0], [0.15, -1.05, 4_690_000.0], [2e-5, -1e-5, 1.0]])
TRUTH[:2] += np.outer([330_000.0, 4_690_000.0], TRUTH[2] - (0.0, 0.0, 1.0))


def matches(n=12, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0, 800, (n, 2))
    ground = place(TRUTH, pixels) + rng.normal(0.0, noise, (n, 2)) if noise else place(TRUTH, pixels)
    return [TiePoint(*pixel, *there) for pixel, there in zip(pixels.tolist(), ground.tolist(), strict=True)]


@pytest.mark.parametrize("n", [4, 5, 30])
def test_exact_matches_are_met(n):
    found = fit(matches(n))
    assert max(found.residuals) < 1e-3
    assert (
        np.abs(place(found.matrix, np.array([[400.0, 300.0]])) - place(TRUTH, np.array([[400.0, 300.0]]))).max() < 1e-2
    )


def test_it_is_the_least_squares_that_opencv_finds():
    given = matches(25, noise=2.0)
    found = fit(given)
    source = np.array([(item.column, item.row) for item in given])
    target = np.array([(item.x, item.y) for item in given])
    middle = target.mean(axis=0)
    theirs, _ = cv2.findHomography(source, target - middle, 0)
    mapped = cv2.perspectiveTransform(source[None], theirs)[0] + middle
    assert rms(found.residuals) <= np.sqrt(np.mean(np.sum((mapped - target) ** 2, axis=1))) + 1e-4


def test_a_wrong_match_is_told_and_can_be_switched_off_or_dragged_back():
    given = matches(12)
    right = given[5]
    given[5] = TiePoint(right.column, right.row, right.x + 80.0, right.y)
    worst = fit(given)
    assert int(np.argmax(worst.residuals)) == 5
    given[5] = TiePoint(right.column, right.row, right.x + 80.0, right.y, on=False)
    found = fit(given)
    assert found.residuals[5] == pytest.approx(80.0, abs=1e-2)  # told of what is off, too
    assert max(apart for k, apart in enumerate(found.residuals) if k != 5) < 1e-3
    given[5] = right
    assert rms(fit(given).residuals) < 1e-3


@pytest.mark.parametrize(
    "given",
    [
        [],
        matches(3),
        [TiePoint(100.0 * k, 50.0 * k, 100.0 * k, 50.0 * k) for k in range(8)],
        [TiePoint(match.column, match.row, match.x, match.y, k < 3) for k, match in enumerate(matches(9))],
    ],
)
def test_too_little_is_no_fit(given):
    found = fit(given)
    assert found.matrix is None
    assert len(found.residuals) == len(given)
    assert np.isnan(found.residuals).all()


def test_what_is_written_is_read_and_what_is_no_such_file_is_told(tmp_path):
    given = [*matches(6), TiePoint(1.0, 2.0, 3.0, 4.0, on=False)]
    path = tmp_path / "matches.points"
    path.write_text(format_points("LOCAL_CS[...]", given, fit(given)), "utf-8")
    assert read_points(path) == ("LOCAL_CS[...]", given)
    for text in (
        "nothing",
        "mapX,mapY,sourceX,sourceY,enable\n1,2,3,x,1",
        "mapX,mapY,sourceX,sourceY,enable\n1,2,3,nan,1",
    ):
        path.write_text(text, "utf-8")
        if text != "nothing":
            with pytest.raises(ValueError, match="control point"):
                read_points(path)
        else:
            assert read_points(path) == ("", [])
    with pytest.raises(ValueError, match="cannot be read"):
        read_points(tmp_path / "nonesuch.points")
