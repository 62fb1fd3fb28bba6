"""The Python environment that roadgeo runs in: tried by calling it, or made."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from qgis.core import QgsApplication, QgsProcessingException

from .runner import as_command, find_pythons

if TYPE_CHECKING:
    from .session import Session

__all__ = ["ENVIRONMENT", "SOURCE", "ask_version", "install"]

#: Where it is made, beside the profiles, which share it.
ENVIRONMENT = Path(QgsApplication.qgisSettingsDirPath()).parents[1] / "roadgeo"

#: The requirement for pip: the wheel that came with the plugin, as a package; else the package that pip finds.
SOURCE = next(map(str, Path(__file__).parent.glob("roadgeo-*.whl")), "roadgeo")

#: A Python has to be new enough, and have venv and pip; it prints its version in any case.
_TRIAL = "import sys; print(sys.version.split()[0]); import ensurepip, venv; sys.exit(sys.version_info < (3, 11))"


def ask_version(path: str, session: Session) -> str:
    """Call roadgeo, by its program or a Python that has it, and return its version.

    Raises
    ------
    QgsProcessingException
        It is not there, or does not run.
    """
    lines = session.tell(*as_command(path), "--version")
    if not lines or "roadgeo" not in lines[-1]:
        raise QgsProcessingException(f"{path} is not roadgeo: it says {lines[-1:]}")
    return lines[-1].split()[-1]


def install(python: str, source: str, folder: Path, session: Session) -> str:
    """Make an environment, have pip install roadgeo there, and return its program.

    Parameters
    ----------
    python : str
        That makes it; "": the first on this computer that can.
    source : str
        The requirement for pip.

    Raises
    ------
    QgsProcessingException
        No such Python, a folder that holds other things, or a step failed; the message is its own.
    """
    if folder.exists() and not (folder / "pyvenv.cfg").is_file() and any(folder.iterdir()):
        raise QgsProcessingException(f"{folder} holds other things; name a folder that is empty or not there yet")
    made = _choose(python, session)
    session.feedback.setProgressText(f"Making an environment in {folder} ...")
    session.tell(made, "-I", "-m", "venv", str(folder))
    scripts, ending = ("Scripts", ".exe") if sys.platform == "win32" else ("bin", "")
    session.feedback.setProgressText(f"Installing {source} ...")
    python = str(folder / scripts / f"python{ending}")
    try:
        session.tell(python, "-I", "-m", "pip", "install", "--disable-pip-version-check", "--progress-bar=off", source)
    except QgsProcessingException as error:
        advice = "; give under “What to install” a wheel, the folder of its sources or an address, in full"
        raise QgsProcessingException(f"{source} was not installed: {error}{advice}") from error
    return str(folder / scripts / f"roadgeo{ending}")


def _choose(python: str, session: Session) -> str:
    """Return the Python that was named, or the first that is new enough and can make environments."""
    named = [python] if python else find_pythons(os.environ, Path.home())
    for path in named:
        try:
            session.tell(path, "-I", "-c", _TRIAL)
        except QgsProcessingException:
            continue
        return path
    looked = ", ".join(named) or "none was found"
    raise QgsProcessingException(
        f"roadgeo needs Python 3.11 or newer with venv and pip, and there is none ({looked}); install one from "
        "python.org or with the system's packages (Debian: python3-venv), and name it above"
    )
