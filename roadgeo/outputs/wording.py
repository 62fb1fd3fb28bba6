"""Numbers as people write them: everywhere the same."""

from __future__ import annotations

import math

__all__ = ["format_lonlat", "write_distance", "write_sigma"]


def format_lonlat(lon: float, lat: float) -> str:
    """Write a position as people do: 41.15253° N, 8.60801° W."""
    return f"{abs(lat):.5f}° {'N' if lat >= 0 else 'S'}, {abs(lon):.5f}° {'E' if lon >= 0 else 'W'}"


def write_distance(metres: float) -> str:
    """Write a distance with two or three digits: 0.28 m, 3.2 m, 47 m, 930 m, 1.3 km, 26 km."""
    if metres >= 995:
        return f"{metres / 1000:.1f} km" if metres < 9950 else f"{metres / 1000:,.0f} km"
    if metres >= 99.5:
        return f"{round(metres, -1):.0f} m"
    return f"{metres:.2f} m" if metres < 0.095 else f"{metres:.1f} m" if metres < 9.95 else f"{metres:.0f} m"


def write_sigma(metres: float) -> str:
    """Write a standard deviation: ± 1.3 m; "" where it is not known."""
    return f"± {write_distance(metres)}" if math.isfinite(metres) else ""
