import errno
import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import Mock

import pytest

from roadgeo.errors import OutputError
from roadgeo.storage import files
from roadgeo.storage.files import replacing, write_text, writing


def test_a_file_that_must_not_replace_another(tmp_path: Path) -> None:
    write_twice(tmp_path, "exists")


def write_twice(tmp_path: Path, message: str) -> None:
    target = tmp_path / "a.txt"
    for content in ("first", "second"):
        with pytest.raises(OutputError, match=message) if target.exists() else nullcontext():  # noqa: SIM117
            with replacing(target, may_exist=False) as staged:
                staged.write_text(content)
    assert target.read_text() == "first"
    assert list(tmp_path.iterdir()) == [target]


def test_content_is_on_the_disk_before_its_name_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a power cut the name stands for the old content or the new."""
    steps, sync, rename = [], os.fsync, files._rename
    monkeypatch.setattr(os, "fsync", lambda descriptor: (steps.append("sync"), sync(descriptor)))
    monkeypatch.setattr(files, "_rename", lambda *paths: (steps.append("rename"), rename(*paths)))
    write_text(tmp_path / "a.txt", "content")
    assert steps == ["sync", "rename", "sync"]


def test_a_disk_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "no hard links")

    monkeypatch.setattr(os, "link", refuse)
    write_twice(tmp_path, "may write to")


@pytest.mark.parametrize("is_full", [False, True])
def test_where_none_may_leave_its_folder_a_copy_takes_the_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_full: bool
) -> None:
    """Inside the fence of an old Linux; the copy is whole or not there, too."""
    rename, target = Path.replace, tmp_path / "a.txt"
    target.write_text("old")

    def within(path: Path, other: Path) -> Path:
        if path.parent != other.parent:
            raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))
        return rename(path, other)

    def fill(source: Path, copy: Path) -> None:
        copy.write_text("ne")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "replace", within)
    if is_full:
        monkeypatch.setattr("shutil.copyfile", fill)
    with pytest.raises(OutputError, match="free some space") if is_full else nullcontext():
        write_text(target, "new")
    assert target.read_text() == ("old" if is_full else "new")
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, OSError])
def test_nothing_is_left_when_writing_fails(tmp_path: Path, error: type[BaseException]) -> None:
    def fail() -> None:
        with replacing(tmp_path / "a.txt") as staged:
            staged.write_text("half")
            raise error

    with pytest.raises(OutputError if error is OSError else error):
        fail()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("at", ["pathlib.Path.open", "shutil.rmtree"])
def test_an_interrupt_while_a_folder_is_made_or_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(at, Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            write_text(tmp_path / "a.txt", "whole")
    assert list(tmp_path.glob(".*"))
    files.remove_own()  # as a process does that ends
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("number", "remedy"),
    [(errno.ENOSPC, "free some space"), (errno.EROFS, "may write to"), (errno.EIO, "check the disk")],
)
def test_errors_name_file_cause_and_remedy(number: int, remedy: str) -> None:
    with pytest.raises(OutputError, match=rf"cannot write some\.gpkg: .*{remedy}"), writing("some.gpkg"):
        raise OSError(number, os.strerror(number))


def test_a_missing_folder_and_a_file_as_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="create the folder"), replacing(tmp_path / "none" / "a.txt"):
        pass
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="not a file"), replacing(tmp_path / "file" / "a.txt"):
        pass


def hold_staging(target: Path) -> subprocess.Popen[bytes]:
    """Start another process that stays in the middle of writing `target`."""
    code = (
        "import sys, time; from roadgeo.storage.files import replacing\n"
        "with replacing(sys.argv[1]) as staged:\n"
        "    staged.with_name('half').write_text('x'); print('ready', flush=True); time.sleep(60)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(target)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    return process


def test_a_living_writer_is_left_alone_and_a_dead_one_cleared_away(tmp_path: Path) -> None:
    with hold_staging(tmp_path / "other.txt") as process:
        (folder,) = tmp_path.iterdir()
        write_text(tmp_path / "a.txt", "")
        assert (folder / "half").exists()
        process.send_signal(signal.SIGKILL)
    assert folder.exists()
    (tmp_path / ".roadgeo-0123456789ab.tmp").mkdir()  # killed between making the folder and its lock
    files._remove_leftovers_once.cache_clear()
    write_text(tmp_path / "a.txt", "")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_folders_of_one_relative_name_are_each_cleared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for place in ("first", "second"):
        (tmp_path / place / "out" / ".roadgeo-0123456789ab.tmp").mkdir(parents=True)
        monkeypatch.chdir(tmp_path / place)
        write_text(Path("out/a.txt"), "")
        assert [path.name for path in Path("out").iterdir()] == ["a.txt"]


def test_foreign_files_of_similar_names_stay(tmp_path: Path) -> None:
    (tmp_path / ".roadgeo-notes.tmp").mkdir()
    (tmp_path / ".roadgeo-notes.tmp" / "mine.txt").touch()
    (tmp_path / ".roadgeo-empty.tmp").mkdir()
    (tmp_path / "x.tmp").touch()
    write_text(tmp_path / "a.txt", "")
    names = {".roadgeo-empty.tmp", ".roadgeo-notes.tmp", "a.txt", "x.tmp"}
    assert {path.name for path in tmp_path.iterdir()} == names


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no users here")
def test_leftovers_of_other_users_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / ".roadgeo-0123456789ab.tmp").mkdir()
    monkeypatch.setattr(os, "getuid", lambda: -2)
    write_text(tmp_path / "a.txt", "")
    assert len(list(tmp_path.iterdir())) == 2


def test_many_writers_in_one_folder(tmp_path: Path) -> None:
    code = (
        "import sys; from roadgeo.storage import files\n"
        "for i in range(60):\n"
        "    files._remove_leftovers_once.cache_clear(); files.write_text(sys.argv[1], 'whole')\n"
    )
    writers = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path / f"{i % 2}.txt")]) for i in range(3)]
    while any(writer.poll() is None for writer in writers):
        for target in tmp_path.glob("*.txt"):
            assert target.read_text() == "whole"
        time.sleep(0.002)
    assert [writer.returncode for writer in writers] == [0, 0, 0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.txt", "1.txt"]


def test_the_old_file_stands_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_text(path, "old")

    def fail_halfway() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half")
            assert temporary.suffix == ".json"
            assert os.name == "nt" or temporary.parent.stat().st_mode & 0o777 == 0o700
            assert path.read_text() == "old"
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail_halfway()
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
    assert path.read_text() == "old"
    write_text(path, "new\n")
    assert path.read_bytes() == b"new\n"


@pytest.mark.skipif(not hasattr(os, "symlink"), reason="no links here")
def test_planted_links_are_not_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither at the target, nor where the unfinished file will be, nor in the place of a lock."""
    victim, folder = tmp_path / "victim", tmp_path / "out"
    victim.write_text("precious")
    folder.mkdir()
    (folder / "a.json").symlink_to(victim)
    (folder / f".a.{os.getpid()}.part.json").symlink_to(victim)
    (folder / f".roadgeo-{'00' * 6}.tmp").symlink_to(tmp_path, target_is_directory=True)
    (folder / f".roadgeo-{'11' * 6}.tmp").mkdir()
    (folder / f".roadgeo-{'11' * 6}.tmp" / "lock").symlink_to(victim)
    names = iter((bytes(6), b"\2" * 6, b"\3" * 6))
    monkeypatch.setattr(os, "urandom", lambda _: next(names))
    with pytest.raises(OutputError, match="exists"):
        write_text(folder / "a.json", "{}")
    write_text(folder / "a.json", "{}")
    files._remove_leftovers_once.cache_clear()
    write_text(folder / "b.json", "")
    assert victim.read_text() == "precious"
    assert (folder / f".roadgeo-{'11' * 6}.tmp" / "lock").is_symlink()
    assert (folder / "a.json").read_text() == "{}"
    assert not (folder / "a.json").is_symlink()


def test_errors_name_the_file_not_where_it_was_staged(tmp_path: Path) -> None:
    with pytest.raises(OutputError) as raised, replacing(tmp_path / "a.json") as staged:
        raise OutputError(f"cannot write {staged}: no room")
    assert str(raised.value) == f"cannot write {tmp_path / 'a.json'}: no room"


def test_a_process_that_ends_takes_its_temporary_folder_along(tmp_path: Path) -> None:
    program = """
import sys
from pathlib import Path
from roadgeo.storage.files import make_temporary_folder
print(make_temporary_folder(Path(sys.argv[1])).is_dir())
"""
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=True, capture_output=True, text=True)
    assert done.stdout == "True\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_process_that_is_forked_off_removes_nothing_of_its_parents(tmp_path: Path) -> None:
    program = """
import os, sys
from pathlib import Path
from roadgeo.storage.files import replacing
with replacing(Path(sys.argv[1])) as staged:
    staged.write_text("whole")
    if not os.fork():
        sys.exit()
    os.wait()
"""
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "a.txt")], check=True)
    assert (tmp_path / "a.txt").read_text() == "whole"
