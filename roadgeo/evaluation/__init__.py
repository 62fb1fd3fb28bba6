"""Masks whose place is known, and how well masks are located."""
