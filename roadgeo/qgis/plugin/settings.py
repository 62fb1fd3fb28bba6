"""Where the executable is: an entry of Processing's settings, or found."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from processing.core.ProcessingConfig import ProcessingConfig, Setting

from .runner import find_executable

__all__ = ["NOT_FOUND", "add_settings", "locate_executable", "remove_settings"]

_EXECUTABLE = "ROADGEO_EXECUTABLE"

NOT_FOUND = (
    "The program roadgeo was not found. Install it as its README tells, then run `roadgeo qgis install`; or set its "
    "path in Settings > Options > Processing > Providers > roadgeo."
)


def add_settings(group: str, icon: Any) -> None:
    """Add the entry to Processing's settings."""
    ProcessingConfig.settingIcons[group] = icon
    label = "Path of the executable roadgeo (empty: search for it)"
    ProcessingConfig.addSetting(Setting(group, _EXECUTABLE, label, "", valuetype=Setting.FILE))
    ProcessingConfig.readSettings()


def remove_settings() -> None:
    """Remove the entry."""
    ProcessingConfig.removeSetting(_EXECUTABLE)


def locate_executable() -> str | None:
    """Return the path of the executable, or None."""
    configured = str(ProcessingConfig.getSetting(_EXECUTABLE) or "")
    return find_executable(configured, os.environ, Path.home(), Path(__file__).parent)
