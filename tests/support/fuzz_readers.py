"""Feed bytes of every kind to a reader of files from strangers; it may only read them or refuse them in a line.

    python tests/support/fuzz_readers.py READER [--runs 100000] [--folder build/fuzz]

READER is one of those in `readers.py`. Guided by the coverage of roadgeo's own Python code (atheris, from PyPI, is
needed; what C libraries do inside, it does not see). It goes on where it was: the folder keeps what was found to lead
somewhere new, and how many files each reader was given. A finding is any error but roadgeo's own, more than 5 seconds
or 1 GB, and a file, a program or a connection that the reader opened; its bytes are written to the folder `findings`.
The exit status is then 1, or libFuzzer's where the process broke.
"""

import argparse
import hashlib
import os
import resource
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import atheris

sys.path.insert(0, str(Path(__file__).parents[1]))

_ROOT = Path(__file__).parents[2]
#: Folders that compute: kernels are compiled, and of arrays that are compared atheris keeps every one.
_COMPUTING = [
    ".".join(path.relative_to(_ROOT).with_suffix("").parts)
    for folder in ("kernels", "geometry", "roads", "matching")
    for path in (_ROOT / "roadgeo" / folder).rglob("*.py")
]
_INSTRUMENTED = {"include": ["roadgeo"], "exclude": _COMPUTING}

with atheris.instrument_imports(**_INSTRUMENTED):
    from support.readers import CORPUS, READERS, drivers_registered_once, feed, seeds

_SECONDS, _BYTES = 5, 1 << 30
_FORBIDDEN = ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto", "subprocess.Popen",
              "os.system", "os.exec", "os.posix_spawn", "os.fork", "ctypes.dlopen")  # fmt: skip
#: What files make of numbers, and what ends a text.
_WORDS = ("1e308", "-1e308", "1e-320", "nan", "inf", "-inf", "Infinity", "18446744073709551616", "-2147483649",
          "null", "true", "[]", "{}", "\\x00", "\\xff\\xff\\xff\\xff", "\\x7f\\xff\\xff\\xff", "\\x00\\x00\\xf0\\x7f",
          "../../", "/vsicurl/http://", "http://127.0.0.1:9/", "\\x1b[31m", "\\xed\\xa0\\x80")  # fmt: skip


class Watch:
    """Hears, while it is on, of files that are opened to be written elsewhere, of programs and of connections."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.on = str(folder), False
        self.heard: list[str] = []
        sys.addaudithook(self._hear)

    def _hear(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.on:
            return
        if event in _FORBIDDEN or (event == "open" and self._writes(*args)):
            self.heard.append(f"{event} {args[:1]}")

    def _writes(self, path: Any, mode: Any, flags: Any) -> bool:
        changes = isinstance(flags, int) and bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        return changes and isinstance(path, str | bytes) and not os.fsdecode(path).startswith((self.folder, os.devnull))


class Judge:
    """Counts what a reader is given, and keeps what it did wrong: one file for each place where it does."""

    def __init__(self, item: Callable[[bytes], None], folder: Path, results: Path, most: int) -> None:
        self._one, self._watch, self._temporary, self._most = item, Watch(folder), folder / "tmp", most
        self._findings, self._counter = results / "findings", results / "executions"
        self._findings.mkdir(parents=True, exist_ok=True)
        self.count = int(self._counter.read_text()) if self._counter.exists() else 0
        self._start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    def __call__(self, content: bytes) -> None:
        self.count += 1
        try:
            self._watch.on = True
            self._one(content)
            self._watch.on = False
            self._check()
        except Exception as error:
            self._watch.on = False
            self._keep(content, error)
        if self.count % 100 == 0:
            self._write_down()
        if self.count >= self._most:
            self.end()

    def _check(self) -> None:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        grown, self._start = (peak - self._start) * 1024, max(peak, self._start)
        assert grown < _BYTES, f"took {grown >> 20} MB"
        heard, self._watch.heard = self._watch.heard, []
        assert not heard, f"opened {heard[:3]}"
        left = [path.name for path in self._temporary.iterdir()]
        assert not left, f"left {left} behind"

    def _keep(self, content: bytes, error: Exception) -> None:
        reported = "".join(traceback.format_exception(error))
        places = [line for line in reported.splitlines() if line.startswith("  File")]
        name = type(error).__name__ + "-" + hashlib.sha256("".join(places).encode()).hexdigest()[:8]
        if not (self._findings / name).exists():
            (self._findings / name).write_bytes(content)
            (self._findings / f"{name}.txt").write_text(reported)

    def _write_down(self) -> None:
        written = self._counter.with_suffix(".new")
        written.write_text(str(self.count))
        written.replace(self._counter)

    def end(self) -> None:
        """Write down what was counted, and leave at once: libFuzzer does not come back."""
        self._write_down()
        found = sorted(path.name for path in self._findings.glob("*.txt"))
        print(f"{self.count} files, findings: {', '.join(found) or 'none'}", flush=True)
        os._exit(int(any(self._findings.iterdir())))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reader", choices=sorted(READERS))
    parser.add_argument("--runs", type=int, default=100_000, help="files in all, with those of earlier times")
    parser.add_argument("--folder", type=Path, default=Path("build/fuzz"))
    return parser.parse_args()


def _libfuzzer(reader: str, results: Path) -> list[str]:
    """Return what libFuzzer is told: files somewhat longer than the seeds, for else it hardly gets through them."""
    corpus, words = results / "corpus", results / "words"
    corpus.mkdir(parents=True, exist_ok=True)
    words.write_text("".join(f'"{word}"\n' for word in _WORDS))
    longest = max(path.stat().st_size for path in seeds(reader))
    options = {"timeout": _SECONDS, "rss_limit_mb": 2048, "max_len": longest + 512, "len_control": 0}
    options |= {"dict": words, "artifact_prefix": f"{results}/findings/", "verbosity": 0, "print_final_stats": 0}
    return [sys.argv[0], str(corpus), str(CORPUS / reader), *(f"-{key}={value}" for key, value in options.items())]


def main() -> None:
    """Fuzz a reader until it was given so many files."""
    given = _arguments()
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    folder = Path(tempfile.mkdtemp(prefix="roadgeo-fuzz-", dir=memory))
    (folder / "tmp").mkdir()
    tempfile.tempdir = os.environ["TMPDIR"] = os.environ["CPL_TMPDIR"] = str(folder / "tmp")
    results = (given.folder / given.reader).resolve()
    with drivers_registered_once():
        item = feed(READERS[given.reader], folder)
        with atheris.instrument_imports(**_INSTRUMENTED):
            for path in seeds(given.reader):  # what is compiled or imported at first use takes longer than 5 seconds
                try:
                    item(path.read_bytes())
                except Exception as error:
                    print(f"{path}: {error!r}", file=sys.stderr)
        judge = Judge(item, folder, results, given.runs)
        if judge.count >= given.runs:
            judge.end()
        atheris.Setup(_libfuzzer(given.reader, results), judge)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
