"""How the options of a search follow from what is asked of its answer."""

import pytest

from roadgeo.matching.methods import promising_options
from roadgeo.matching.options import LocateOptions


@pytest.mark.parametrize(("least", "margin", "promising"), [(3.5, 2.0, 1.0), (2.0, 2.0, 0.0), (3.5, 4.0, -0.5)])
def test_what_may_be_reported_or_rival_it_is_promising(least: float, margin: float, promising: float) -> None:
    options = LocateOptions(min_log10_odds=least, min_margin=margin)
    assert promising_options(options).verify.promising == promising


def test_a_higher_demand_leaves_the_search_as_it_is() -> None:
    assert promising_options(LocateOptions(min_log10_odds=9.0)) == LocateOptions().match
