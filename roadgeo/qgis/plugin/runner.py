"""The roadgeo executable as a child process: where it is, its environment, its output, how it is stopped.

Knows nothing of QGIS, whose Python carries other versions of the libraries that roadgeo uses: nothing of roadgeo is
imported here, nor anything of QGIS there.
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import signal
import subprocess  # nosec B404
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

__all__ = [
    "REMEMBERED",
    "as_command",
    "child_environment",
    "find_below",
    "find_executable",
    "find_program",
    "find_pythons",
    "in_words_of_qgis",
    "run",
]

#: File beside this one in which `roadgeo qgis install` leaves the path of the executable that ran it.
REMEMBERED = "executable.txt"

_NAME, _SCRIPTS = ("roadgeo.exe", "Scripts") if sys.platform == "win32" else ("roadgeo", "bin")

#: Where programs and environments are put below the home folder; QGIS often starts with a shorter PATH than a terminal.
#: No pattern stands for a folder in the home folder itself: an archive that was unpacked there would be started.
_CONDAS = ("miniconda3", "anaconda3", "miniforge3", "mambaforge", "micromamba", ".conda", ".local/share/mamba")
_PLACES = (
    ".local/bin",
    f".local/share/uv/tools/roadgeo/{_SCRIPTS}",
    f".local/share/pipx/venvs/roadgeo/{_SCRIPTS}",
    f"pipx/venvs/roadgeo/{_SCRIPTS}",
    f".venv/{_SCRIPTS}",
    f".virtualenvs/*/{_SCRIPTS}",
    *(f"{conda}/envs/*/{_SCRIPTS}" for conda in _CONDAS),
    "Library/Python/3*/bin",
    "AppData/Roaming/Python/Python3*/Scripts",
    "AppData/Local/Programs/Python/Python3*/Scripts",
)

#: Commands that messages name, and their counterparts in QGIS.
_COMMANDS = {
    "apply": "Mend a place by hand",
    "index": "Build road reference",
    "reference": "the list of road references",
    "locate": "Locate mask or photograph",
    "vectorize": "Vectorize mask or photograph",
}

#: Variables that QGIS sets for its own Python, PROJ and GDAL would break another's.
_NOT_INHERITED = ("PYTHON", "__PYVENV", "PROJ_", "GDAL_")

#: How long a child may take to clean up after it was asked to stop, and how often we look whether it should.
_GRACE_S, _LOOK_S = 3.0, 0.1


def find_executable(configured: str, environ: Mapping[str, str], beside: Path) -> str | None:
    """Find the roadgeo executable that the user chose, or return None.

    Parameters
    ----------
    configured : str
        Path from the settings; "" searches: ROADGEO_EXECUTABLE, the path that the installer left in the folder
        `beside`, and PATH.
    """
    if configured:
        return find_program(configured, environ)
    remembered = beside / REMEMBERED
    names = [environ.get("ROADGEO_EXECUTABLE", ""), remembered.read_text("utf-8") if remembered.is_file() else ""]
    programs = (find_program(name.strip(), environ) for name in [*names, _NAME] if name.strip())
    return next(filter(None, programs), None)


def find_below(home: Path) -> str:
    """Return an executable in a usual place below the home folder, which the user is to be asked for; "" without one.

    Anybody's archive may have been unpacked there.
    """
    places = (place / _NAME for pattern in _PLACES for place in sorted(home.glob(pattern)))
    return next((str(program) for program in places if _is_executable(program)), "")


def find_pythons(environ: Mapping[str, str], home: Path) -> list[str]:
    """List Pythons that roadgeo may be installed with, the newest first as far as names show it."""
    ending = ".exe" if sys.platform == "win32" else ""
    names = [*(f"python3.{minor}" for minor in range(15, 10, -1)), "python3", "python"]
    names += [str(Path(sys.prefix, part, f"python3{ending}")) for part in ("bin", "")]  # QGIS's own
    names += [str(path) for path in sorted(home.glob(f"AppData/Local/Programs/Python/Python3*/python{ending}"))]
    return list(dict.fromkeys(filter(None, (find_program(name, environ) for name in names))))


def find_program(name: str, environ: Mapping[str, str]) -> str | None:
    """Return the full path of a program that is given by its path, or by its name in the folders of PATH.

    The current folder is passed over, whatever PATH holds and Windows does: anybody's files may lie there.
    """
    path = Path(name).expanduser()
    if path.name != name:
        return str(path.absolute()) if _is_executable(path) else None
    if sys.platform == "win32" and path.suffix.lower() != ".exe":
        name += ".exe"
    for folder in map(Path, environ.get("PATH", "").split(os.pathsep)):
        if folder.is_absolute() and _is_executable(folder / name) and not folder.samefile(os.curdir):
            return str(folder / name)
    return None


def _is_executable(path: Path) -> bool:
    return path.is_file() and os.access(path, os.X_OK)


def as_command(path: str) -> list[str]:
    """Return how roadgeo is called by a path from the settings: its program, or a Python that has it.

    `-P` rather than `-I`, which the Python of Windows' store could not find it with: that installs for one user alone.
    """
    is_python = re.match(r"python[\d.]*(\.exe)?$", Path(path).name.lower())
    return [path, "-P", "-m", "roadgeo"] if is_python else [path]


def in_words_of_qgis(text: str, labels: Mapping[str, str]) -> str:
    """Return a message of the program with QGIS's names for its commands and options.

    Parameters
    ----------
    labels : mapping
        Labels of the options of the algorithm that runs, by their names on the command line.
    """
    text = re.sub(
        r"`roadgeo (\w+)[^`]*`", lambda match: f"“{_COMMANDS[match[1]]}”" if match[1] in _COMMANDS else match[0], text
    )
    text = re.sub(r" ?Try 'roadgeo [^']*'\.?", "", text)
    text = re.sub(r"pip install '(roadgeo\[\w+\])'", r"“Set up roadgeo” installs \1", text)
    return re.sub(
        r"(--[a-z][a-z-]*)( LON,LAT,\d+)?",  # a place is clicked on the map
        lambda match: f"“{labels[match[1]]}”" if match[1] in labels else match[0],
        text,
    )


def child_environment(environ: Mapping[str, str]) -> dict[str, str]:
    """Return the child's environment: nothing of QGIS's own Python, PROJ and GDAL; UTF-8, and progress as JSON.

    Neither the child nor the workers that it starts import from the current folder.
    """
    kept = {name: value for name, value in environ.items() if not name.startswith(_NOT_INHERITED)}
    own = {"PYTHONIOENCODING": "utf-8", "PYTHONSAFEPATH": "1", "ROADGEO_PROGRESS": "json", "NO_COLOR": "1"}
    return {**kept, **own}


def run(command: Sequence[str], handle: Callable[[str, str], None], is_cancelled: Callable[[], bool]) -> int:
    """Run a command to its end, in the plugin's own folder, and return its exit status.

    Parameters
    ----------
    handle : callable
        Takes "stdout" or "stderr" and a line, in the calling thread.
    is_cancelled : callable
        Asked ten times a second; once true the child and its own children are stopped.
    """
    options: dict[str, Any] = {"encoding": "utf-8", "errors": "replace", "env": child_environment(os.environ)}
    options["cwd"] = Path(__file__).parent  # in the current folder a stranger's modules and settings may lie
    if sys.platform == "win32":
        options["creationflags"] = subprocess.CREATE_NO_WINDOW
    else:
        options["start_new_session"] = True
    pipe = subprocess.PIPE
    options.update(stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe)
    with subprocess.Popen(command, **options) as process:  # noqa: S603 # nosec B603
        stopping = None
        try:
            for line in _lines(process):
                if line is not None:
                    handle(*line)
                elif stopping is None and is_cancelled():
                    stopping = threading.Thread(target=_stop, args=(process,))
                    stopping.start()
        except BaseException:
            _kill(process)
            raise
        if stopping is not None:
            stopping.join()
    return process.returncode


def _lines(process: subprocess.Popen[str]) -> Iterator[tuple[str, str] | None]:
    """Yield lines of both streams with the stream's name as they come, and None whenever it is time to look around."""
    lines: queue.Queue[tuple[str, str]] = queue.Queue()
    readers = [
        threading.Thread(target=_read, args=(name, stream, lines), daemon=True)
        for name, stream in (("stdout", process.stdout), ("stderr", process.stderr))
    ]
    for reader in readers:
        reader.start()
    while any(reader.is_alive() for reader in readers) or not lines.empty():
        with contextlib.suppress(queue.Empty):
            yield lines.get(timeout=_LOOK_S)
        yield None


def _read(name: str, stream: IO[str], lines: queue.Queue[tuple[str, str]]) -> None:
    for line in stream:
        lines.put((name, line.rstrip("\n")))


def _stop(process: subprocess.Popen[str]) -> None:
    """Interrupt the child as Ctrl-C does: it ends its workers and removes half-written files. Kill what it leaves.

    A worker that a hurried child left behind would hold the pipes open, and `run` would wait for it.
    """
    if sys.platform != "win32":
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_GRACE_S)
    _kill(process)


def _kill(process: subprocess.Popen[str]) -> None:
    """End the child and all that it started."""
    if sys.platform == "win32":
        taskkill = Path(os.environ["SYSTEMROOT"], "System32", "taskkill.exe")
        command = [str(taskkill), "/F", "/T", "/PID", str(process.pid)]
        subprocess.run(command, capture_output=True, check=False)  # noqa: S603 # nosec B603
    else:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
