"""A result to look at: one HTML file that needs no network, to zoom into, with the numbers and the reason in words."""

from __future__ import annotations

from roadgeo.report.batch import Entry, render_batch, write_batch
from roadgeo.report.page import render_report, write_report
from roadgeo.report.views import ReportOptions

__all__ = ["Entry", "ReportOptions", "render_batch", "render_report", "write_batch", "write_report"]
