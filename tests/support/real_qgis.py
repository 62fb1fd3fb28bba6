"""The real QGIS as a child process, with a profile of its own."""

import json
import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

CHILD = Path(__file__).with_name("qgis_child.py")
WINDOW = Path(__file__).with_name("qgis_window.py")


@dataclass(frozen=True)
class Qgis:
    """The real QGIS with a profile of its own, into which the plugin was installed."""

    process: str
    python: str
    folder: Path
    environ: dict[str, str]

    def tool(self, *arguments: str, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
        """Run `qgis_process`."""
        return self._run([self.process, *arguments], folder)

    def ask(self, *tasks: tuple[str, dict]) -> tuple[list, list[str], str]:
        """Do tasks of `qgis_child`: what they return, QGIS's warnings, and what was printed as an error."""
        wanted, answers = self.folder / "tasks.json", self.folder / "answers.json"
        wanted.write_text(json.dumps(tasks), "utf-8")
        answers.unlink(missing_ok=True)
        done = self._run([self.python, str(CHILD), str(wanted), str(answers)])
        assert answers.exists(), done.stdout + done.stderr
        document = json.loads(answers.read_text("utf-8"))
        printed = "".join(line for line in done.stderr.splitlines(True) if "setapi() is deprecated" not in line)
        return document["answers"], document["warnings"], printed

    def tour(self, **task: str) -> dict:
        """Use the plugin in QGIS's own window, on a virtual screen; see `qgis_window`."""
        wanted, answer = self.folder / "task.json", self.folder / "answer.json"
        answer.unlink(missing_ok=True)
        wanted.write_text(json.dumps({**task, "answer": str(answer)}), "utf-8")
        command = ["xvfb-run", "--auto-servernum", "--server-args=-screen 0 1280x900x24"]
        command += ["qgis", "--nologo", "--noversioncheck", "--code", str(WINDOW)]
        environ = {**self.environ, "QT_QPA_PLATFORM": "xcb", "ROADGEO_TASK": str(wanted)}
        done = replace(self, environ=environ)._run(command)
        assert answer.exists(), done.stdout + done.stderr
        return json.loads(answer.read_text("utf-8"))

    def _run(self, command: list[str], folder: Path | None = None) -> subprocess.CompletedProcess[str]:
        settings = {"env": self.environ, "cwd": folder or self.folder, "timeout": 600}
        return subprocess.run(command, capture_output=True, text=True, check=False, **settings)


def find_qgis() -> tuple[str, str] | None:
    """Return `qgis_process` and the Python that QGIS can be imported in."""
    process = shutil.which("qgis_process.bin") or shutil.which("qgis_process")
    pythons = [path for path in ("/usr/bin/python3", shutil.which("python3")) if path and Path(path).exists()]
    for python in pythons if process else []:
        if subprocess.run([python, "-c", "import qgis.core"], capture_output=True, check=False).returncode == 0:
            return process, python
    return None
