"""Putting the plugin into a QGIS profile, or into a package for QGIS's plugin repository."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import sys
import sysconfig
import zipfile
from base64 import urlsafe_b64encode
from collections.abc import Mapping
from email.utils import parseaddr
from hashlib import sha256
from importlib import metadata
from pathlib import Path

import roadgeo
from roadgeo.errors import OutputError
from roadgeo.outputs.registry import ALSO
from roadgeo.qgis.plugin.runner import REMEMBERED
from roadgeo.storage.files import write_bytes, writing

__all__ = ["NAME", "find_profiles", "install_plugin", "write_package"]

#: Name of the plugin's folder: not `roadgeo`, which would stand before the library of that name in QGIS's Python.
NAME = "roadgeo_qgis"

#: Name of the file that lists options and outputs for the plugin, which runs without the library; their commands.
TABLE, _COMMANDS = "table.json", ("locate", "index", "evaluate")

_PLUGIN = Path(__file__).parent / "plugin"


def install_plugin(profile: Path) -> Path:
    """Copy the plugin into a profile, in place of an earlier one, and enable it.

    The copy remembers the executable that runs now, so it needs no search.

    Returns
    -------
    Path
        The plugin's folder.

    Raises
    ------
    OutputError
        The profile cannot be written to.
    """
    target = profile / "python" / "plugins" / NAME
    with writing(target):
        if target.is_symlink():
            target.unlink()  # the link, not what it leads to
        elif target.exists():
            shutil.rmtree(target)
        for file, content in _contents().items():
            (target / file).parent.mkdir(parents=True, exist_ok=True)
            (target / file).write_bytes(content)
        executable = _this_executable()
        if executable is not None:
            (target / REMEMBERED).write_text(f"{executable}\n", encoding="utf-8")
        _enable(profile)
    return target


def write_package(path: str | os.PathLike[str], publisher: Mapping[str, str] | None = None) -> None:
    """Write the plugin as the ZIP that QGIS installs, and that its plugin repository takes; roadgeo itself lies in it.

    Parameters
    ----------
    publisher : mapping, optional
        Fields that the repository requires: `email`, `repository`, `tracker`, `homepage`. Default: as in the package.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    files = {f"{NAME}/{file.as_posix()}": content for file, content in _contents().items()}
    fields = {**_publisher(), **(publisher or {})}
    files[f"{NAME}/metadata.txt"] += "".join(f"{key}={value}\n" for key, value in fields.items()).encode()
    files.update((f"{NAME}/{name}", content) for name, content in _make_wheel().items())
    write_bytes(Path(path), _pack(files))


def _make_wheel() -> dict[str, bytes]:
    """Return name and content of a wheel of roadgeo as it is installed, so that the plugin can have it installed."""
    distribution = metadata.distribution("roadgeo")
    stem, root = f"roadgeo-{distribution.version}", Path(roadgeo.__file__).parent
    files = {f"roadgeo/{file.as_posix()}": content for file, content in _read_folder(root).items()}
    described = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO")  # PKG-INFO is a checkout's
    for name, text in (("METADATA", described), ("entry_points.txt", distribution.read_text("entry_points.txt"))):
        files[f"{stem}.dist-info/{name}"] = (text or "").encode()
    files[f"{stem}.dist-info/WHEEL"] = (
        b"Wheel-Version: 1.0\nGenerator: roadgeo\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    )
    record = "".join(f"{name},sha256={_digest(content)},{len(content)}\n" for name, content in files.items())
    files[f"{stem}.dist-info/RECORD"] = f"{record}{stem}.dist-info/RECORD,,\n".encode()
    return {f"{stem}-py3-none-any.whl": _pack(files)}


def _digest(content: bytes) -> str:
    """Return the SHA-256 as a wheel's record has it."""
    return urlsafe_b64encode(sha256(content).digest()).decode().rstrip("=")


def _pack(files: Mapping[str, bytes]) -> bytes:
    """Return a ZIP; dates of their own would make the same files another one each time."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


def _read_folder(folder: Path) -> dict[Path, bytes]:
    """Read all files of a Python package, by their paths in it, without compiled ones."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and "__pycache__" not in path.parts)
    return {file.relative_to(folder): file.read_bytes() for file in files}


def _publisher() -> dict[str, str]:
    """Return the contacts in pyproject.toml, which serve the whole package."""
    package = metadata.metadata("roadgeo")
    urls = dict(entry.split(", ", 1) for entry in package.get_all("Project-URL") or [])
    fields = {
        "email": parseaddr(package["Author-email"] or "")[1],
        "homepage": urls.get("Homepage", ""),
        "repository": urls.get("Repository", ""),
        "tracker": urls.get("Issues", ""),
    }
    return {key: value for key, value in fields.items() if value}


def _contents() -> dict[Path, bytes]:
    """Read the plugin's files, by their paths in its folder; with the table of options, and the outputs of `--also`."""
    from roadgeo.cli.table import describe_options

    offered = {name: output.summary for name, output in ALSO.items()}
    table = {"options": describe_options(_COMMANDS), "outputs": offered}
    return {**_read_folder(_PLUGIN), Path(TABLE): (json.dumps(table, indent=1) + "\n").encode()}


def _this_executable() -> Path | None:
    """Return the program that runs now, or the one of the running Python."""
    name = "roadgeo.exe" if sys.platform == "win32" else "roadgeo"
    running = Path(sys.argv[0]).absolute()
    candidates = [running.with_name(name)] if running.stem == "roadgeo" else []
    candidates.append(Path(sysconfig.get_path("scripts"), name))
    return next((path for path in candidates if path.is_file()), None)


# --- profiles ---------------------------------------------------------------------------------------------------------


def find_profiles(name_or_folder: str) -> list[Path]:
    """Find the profiles of that name, one in each QGIS of this user (3 and 4, from Flatpak too); or take a folder.

    The profile `default` of a QGIS that was never started is one as well: QGIS completes it when it starts.

    Raises
    ------
    OutputError
        There is no such profile.
    """
    if Path(name_or_folder).is_dir() or Path(name_or_folder).name != name_or_folder:
        return [Path(name_or_folder)]
    roots = _profile_roots()
    folders = [root / name_or_folder for root in roots if (root / name_or_folder).is_dir()]
    if folders or name_or_folder == "default":
        return folders or [roots[0] / name_or_folder]
    names = sorted({profile.name for root in roots if root.is_dir() for profile in root.iterdir() if profile.is_dir()})
    raise OutputError(
        f"QGIS has no profile {name_or_folder!r}; it has {', '.join(names) or 'none'}; or give its folder"
    )


def _profile_roots() -> list[Path]:
    """List where this user's QGIS may keep profiles, first the one of QGIS 3."""
    given = os.environ.get("QGIS_CUSTOM_CONFIG_PATH")
    if given:
        return [Path(given) / "profiles"]
    home = Path.home()
    if sys.platform == "win32":
        bases = [Path(os.environ.get("APPDATA") or home / "AppData" / "Roaming")]
    elif sys.platform == "darwin":
        bases = [home / "Library" / "Application Support"]
    else:
        data = Path(os.environ.get("XDG_DATA_HOME") or home / ".local" / "share")
        bases = [data, home / ".var" / "app" / "org.qgis.qgis" / "data"]
    return [base / "QGIS" / version / "profiles" for base in bases for version in ("QGIS3", "QGIS4")]


def _enable(profile: Path) -> None:
    """Tick the plugin in QGIS's settings: a line in the section of Python plugins."""
    organization = "qgis.org" if sys.platform == "darwin" else "QGIS"
    for settings in sorted(profile.glob("*/QGIS?.ini")) or [profile / organization / "QGIS3.ini"]:
        settings.parent.mkdir(parents=True, exist_ok=True)
        content = settings.read_bytes() if settings.exists() else b""
        write_bytes(settings, _with_line(content, b"PythonPlugins", NAME.encode()))


def _with_line(content: bytes, section: bytes, key: bytes) -> bytes:
    """Return an INI file's content with `key=true` in a section; all else stays, byte for byte."""
    content = re.sub(rb"(?m)^%s=.*(\r?\n|$)" % re.escape(key), b"", content)
    header = re.search(rb"(?m)^\[%s\][ \t]*(\r?\n|$)" % re.escape(section), content)
    if header is None:
        gap = b"\n" if content and not content.endswith(b"\n") else b""
        return content + gap + b"[%s]\n%s=true\n" % (section, key)
    before, after = content[: header.end()], content[header.end() :]
    return before + (b"" if before.endswith(b"\n") else b"\n") + b"%s=true\n" % key + after
