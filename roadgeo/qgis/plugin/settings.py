"""The plugin's memory: where roadgeo is, as an entry of Processing's settings, and which references it built."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis.core import QgsSettings

from .runner import as_command, find_below, find_executable

__all__ = [
    "NOT_FOUND",
    "add_settings",
    "configure",
    "locate_command",
    "locate_executable",
    "propose_executable",
    "remember_reference",
    "remembered_references",
    "remove_settings",
]

_EXECUTABLE, _REFERENCES = "ROADGEO_EXECUTABLE", "roadgeo/references"

#: How many references are remembered.
_MOST = 30

NOT_FOUND = (
    "The program roadgeo was not found on this computer. Plugins > roadgeo > Set up roadgeo finds or installs it; or "
    "set its path in Settings > Options > Processing > Providers > roadgeo."
)


def add_settings(group: str, icon: Any) -> None:
    """Add the entry to Processing's settings."""
    ProcessingConfig.settingIcons[group] = icon
    label = "Program roadgeo, or a Python that has it (empty: search for it)"
    ProcessingConfig.addSetting(Setting(group, _EXECUTABLE, label, "", valuetype=Setting.FILE))
    ProcessingConfig.readSettings()


def remove_settings() -> None:
    """Remove the entry."""
    ProcessingConfig.removeSetting(_EXECUTABLE)


def configure(path: str) -> None:
    """Remember where roadgeo is: its program, or a Python that has it."""
    ProcessingConfig.setSettingValue(_EXECUTABLE, path)


def locate_executable() -> str | None:
    """Return the path of the program, or of a Python that has it, or None."""
    configured = str(ProcessingConfig.getSetting(_EXECUTABLE) or "")
    return find_executable(configured, os.environ, Path(__file__).parent)


def propose_executable() -> str:
    """Return the path of a program in the home folder, which the user is to be asked for before it starts; or ""."""
    return find_below(Path.home())


def locate_command() -> list[str] | None:
    """Return how roadgeo is called, or None."""
    executable = locate_executable()
    return None if executable is None else as_command(executable)


def remember_reference(path: str) -> None:
    """Remember a reference that lies outside roadgeo's library."""
    path = str(Path(path).absolute())
    kept = [one for one in remembered_references() if one != path]
    QgsSettings().setValue(_REFERENCES, "\n".join([path, *kept][:_MOST]))


def remembered_references() -> list[str]:
    """List the references that were built outside roadgeo's library and are still there, the newest first."""
    paths = str(QgsSettings().value(_REFERENCES, "") or "").split("\n")
    return [path for path in paths if path and Path(path).exists()]
