"""Numbers as people write them."""

__all__ = ["format_lonlat"]


def format_lonlat(lon: float, lat: float) -> str:
    """Write a position as people do: 41.15253° N, 8.60801° W."""
    return f"{abs(lat):.5f}° {'N' if lat >= 0 else 'S'}, {abs(lon):.5f}° {'E' if lon >= 0 else 'W'}"
