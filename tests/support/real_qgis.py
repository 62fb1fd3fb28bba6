"""The real QGIS as a child process, with a profile of its own."""

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, Pipe
from pathlib import Path

CHILD = Path(__file__).with_name("qgis_child.py")
WINDOW = Path(__file__).with_name("qgis_window.py")
PATIENCE_S = 600


@dataclass
class Qgis:
    """The real QGIS with a profile of its own, into which the plugin was installed.

    One process answers all that is asked (see `qgis_child`): to start QGIS takes longer than most of it.
    """

    process: str
    python: str
    folder: Path
    environ: dict[str, str]
    _pipe: Connection | None = field(default=None, repr=False)
    _child: subprocess.Popen[bytes] | None = field(default=None, repr=False)

    def tool(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run `qgis_process`."""
        return self._run([self.process, *arguments], self.environ)

    def run(self, algorithm: str, **parameters: object) -> dict:
        """Run an algorithm of the plugin as the toolbox does; see `qgis_child.run`."""
        task = {"algorithm": f"roadgeo:{algorithm}", "parameters": {k: _plain(v) for k, v in parameters.items()}}
        (answer,), _, _ = self.ask(("run", task))
        return answer

    def ask(self, *tasks: tuple[str, dict]) -> tuple[list, list[str], str]:
        """Do tasks of `qgis_child`: what they return, QGIS's warnings, and what was printed as an error."""
        errors = self.folder / "errors.txt"
        pipe = self._pipe = self._pipe or self._start(errors)
        before = errors.stat().st_size
        pipe.send_bytes(json.dumps(tasks).encode())
        assert pipe.poll(PATIENCE_S), f"QGIS has not answered: {tasks}"
        try:
            document = json.loads(pipe.recv_bytes())
        except EOFError:
            self._pipe = None
            document = {"error": "QGIS ended"}
        printed = errors.read_bytes()[before:].decode()
        assert "error" not in document, f"{document['error']}\n{printed}"
        return document["answers"], document["warnings"], printed

    def _start(self, errors: Path) -> Connection:
        """Start the process that answers; it ends with our end of the pipe."""
        ours, theirs = Pipe()
        with theirs, errors.open("wb") as reported:
            command = [self.python, str(CHILD), str(theirs.fileno())]
            settings = {"env": self.environ, "cwd": self.folder, "pass_fds": [theirs.fileno()]}
            self._child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=reported, **settings)
        assert ours.poll(PATIENCE_S), "QGIS does not start"
        try:
            ours.recv_bytes()
        except EOFError:
            raise AssertionError(errors.read_text()) from None
        return ours

    def close(self) -> None:
        """End the process that answers."""
        if self._pipe is not None and self._child is not None:
            self._pipe.close()
            self._child.wait(timeout=PATIENCE_S)

    def tour(self, **task: str) -> dict:
        """Use the plugin in QGIS's own window, on a virtual screen; see `qgis_window`."""
        wanted, answer = self.folder / "task.json", self.folder / "answer.json"
        answer.unlink(missing_ok=True)
        wanted.write_text(json.dumps({**task, "answer": str(answer)}), "utf-8")
        command = ["xvfb-run", "--auto-servernum", "--server-args=-screen 0 1280x900x24"]
        command += ["qgis", "--nologo", "--noversioncheck", "--code", str(WINDOW)]
        environ = {**self.environ, "QT_QPA_PLATFORM": "xcb", "ROADGEO_TASK": str(wanted)}
        done = self._run(command, environ)
        assert answer.exists(), done.stdout + done.stderr
        return json.loads(answer.read_text("utf-8"))

    def _run(self, command: list[str], environ: dict[str, str]) -> subprocess.CompletedProcess[str]:
        settings = {"env": environ, "cwd": self.folder, "timeout": PATIENCE_S}
        return subprocess.run(command, capture_output=True, text=True, check=False, **settings)


def _plain(value: object) -> object:
    return str(value) if isinstance(value, Path) else value


def find_qgis() -> tuple[str, str] | None:
    """Return `qgis_process` and the Python that QGIS can be imported in."""
    process = shutil.which("qgis_process.bin") or shutil.which("qgis_process")
    pythons = [path for path in ("/usr/bin/python3", shutil.which("python3")) if path and Path(path).exists()]
    for python in pythons if process else []:
        if subprocess.run([python, "-c", "import qgis.core"], capture_output=True, check=False).returncode == 0:
            return process, python
    return None


def make_program(path: Path, body: str) -> Path:
    """Write a program in Python, and make it executable."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!{sys.executable}\n{body}", encoding="utf-8")
    path.chmod(0o755)
    return path


def is_running(process: int) -> bool:
    """Whether a process runs on; one that ended is not counted, even if nobody asked for its status yet."""
    for _ in range(50):
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return False
        status = Path(f"/proc/{process}/stat")
        if status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z":
            return False
        time.sleep(0.1)
    return True
