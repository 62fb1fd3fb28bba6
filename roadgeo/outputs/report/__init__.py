"""A result to look at: one HTML file that needs no network, to zoom into, with the numbers and the reason in words."""

from __future__ import annotations

from roadgeo.outputs.report.batch import Entry, render_batch, write_batch
from roadgeo.outputs.report.page import render_report, write_report

__all__ = ["Entry", "render_batch", "render_report", "write_batch", "write_report"]
