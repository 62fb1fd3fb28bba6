"""The fence: what is opened inside it, by whatever asks. Each test has a process of its own, for it is for good."""

import os
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

import pytest

from roadgeo.storage.fence import Fence, abi_version, remedy

pytestmark = pytest.mark.skipif(not abi_version(), reason="this system has no Landlock (Linux 5.13 and later)")


def fenced(folder: Path, body: str, **environment: str) -> str:
    """Run code that knows `Fence`, `Path` and `refused`, which says whether a call is; return what it prints."""
    head = """
    import os, sys
    from pathlib import Path
    from roadgeo.storage import fence
    from roadgeo.storage.fence import Fence
    def refused(do, *arguments):
        try:
            do(*arguments)
        except PermissionError:
            return True
        return False
    """
    program = textwrap.dedent(head) + textwrap.dedent(body)
    surroundings = {**os.environ, "ROADGEO_CACHE": str(folder / "cache"), **environment}
    surroundings.pop("ROADGEO_STAGE", None)
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=folder, env=surroundings, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture
def desk(tmp_path: Path) -> Path:
    for name in ("map.shp", "map.prj", "map.shp.xml", "mapping.shp", "secret.txt"):
        (tmp_path / name).write_text("x")
    (tmp_path / "whole").mkdir()
    (tmp_path / "whole" / "a.tif").write_text("x")
    (tmp_path / "map.dbf").symlink_to("secret.txt")
    for name in ("pipe", "map.qix"):
        os.mkfifo(tmp_path / name)
    return tmp_path


def test_a_file_is_read_with_what_shares_its_stem_and_a_folder_whole(desk: Path) -> None:
    said = fenced(desk, """
        assert Fence(("map.shp", "whole")).enter()
        names = ["map.shp", "map.prj", "map.shp.xml", "whole/a.tif"]
        names += ["mapping.shp", "secret.txt", "pipe", "map.qix", "map.dbf"]
        print([refused(Path(name).read_text) for name in names])
    """)  # fmt: skip
    assert said == str([False] * 4 + [True] * 5)


def test_nothing_of_users_and_programs_is_read(desk: Path) -> None:
    said = fenced(desk, """
        Fence().enter()
        names = ("/etc/passwd", "/etc/shadow", "/proc/self/environ", "/proc/1/cmdline")
        print([refused(Path(name).read_bytes) for name in names], refused(os.listdir, "/root"))
    """)  # fmt: skip
    assert said == "[True, True, True, True] True"


def test_programs_that_are_started_are_inside_too(desk: Path) -> None:
    said = fenced(desk, """
        import subprocess
        Fence().enter()
        print(subprocess.run([sys.executable, "-c", "open('secret.txt')"], capture_output=True).stderr.decode()[-60:])
    """)  # fmt: skip
    assert "Permission denied" in said


def test_results_appear_whole_and_are_not_read(desk: Path) -> None:
    said = fenced(desk, """
        from roadgeo.storage.files import write_text
        Fence((), (".", "new")).enter()
        write_text("result.txt", "whole")
        write_text("result.txt", "again")
        write_text("new/result.txt", "whole")
        print([refused(Path(name).read_text) for name in ("result.txt", "secret.txt", "new/result.txt")])
        print(refused(Path("secret.txt").write_text, ""), refused(Path("..", "elsewhere.txt").write_text, ""))
    """)  # fmt: skip
    assert said == "[True, True, True]\nTrue True"
    assert (desk / "result.txt").read_text() == "again"
    assert (desk / "new" / "result.txt").read_text() == "whole"
    assert not list(desk.glob(".roadgeo*"))


def test_nothing_is_left_where_nothing_was_written(desk: Path) -> None:
    before = {path.name for path in desk.iterdir()}
    (desk / "tmp").mkdir()
    fenced(desk, 'Fence((), ("new",)).enter()', TMPDIR=str(desk / "tmp"))
    assert {path.name for path in desk.iterdir()} == before | {"cache", "tmp"}
    assert not list((desk / "tmp").iterdir())


def test_a_staging_folder_that_another_takes_is_not_followed(desk: Path) -> None:
    """In a folder where all may rename, a folder of the same name leads elsewhere; the writer is refused."""
    said = fenced(desk, """
        from roadgeo.errors import OutputError
        from roadgeo.storage.files import replacing
        os.mkdir("elsewhere")
        Fence((), ("whole",)).enter()
        try:
            with replacing("whole/result.txt") as staged:
                staged.parent.parent.rename("whole/taken")
                os.symlink("../elsewhere", staged.parent.parent)
                staged.parent.mkdir()
                staged.write_text("lost")
        except (OutputError, OSError) as error:
            print("permission denied" in str(error).lower())
    """)  # fmt: skip
    assert said == "True"
    assert not list((desk / "elsewhere").iterdir())


@pytest.mark.skipif(abi_version() < 4, reason="this Landlock knows no network (Linux 6.7 and later)")
def test_no_connection_is_made_unless_it_is_wanted(desk: Path) -> None:
    body = """
        import socket
        server = socket.create_server(("127.0.0.1", 0))
        Fence(network={wanted}).enter()
        print(refused(socket.create_connection, server.getsockname()))
    """
    assert [fenced(desk, body.format(wanted=wanted)) for wanted in (True, False)] == ["False", "True"]


@pytest.mark.parametrize("abi", [1, 2, 3])
def test_earlier_versions_will_do(abi: int, desk: Path) -> None:
    """In the first no file may change its folder: a copy is renamed."""
    said = fenced(desk, f"""
        from roadgeo.storage.files import write_text
        fence.abi_version = lambda: {abi}
        Fence(("map.shp",), (".",)).enter()
        write_text("result.txt", "whole")
        print(refused(Path("secret.txt").read_text), refused(Path("map.prj").read_text))
    """)  # fmt: skip
    assert said == "True False"
    assert (desk / "result.txt").read_text() == "whole"
    assert not list(desk.glob(".roadgeo*"))


def test_temporary_files_of_a_process_that_was_killed_go_with_the_next(desk: Path) -> None:
    temporary = Path(tempfile.mkdtemp(dir=desk.parent))
    other = temporary / ".roadgeo-0123456789ab.tmp"
    other.mkdir()
    (other / "lock").touch()
    here = f"import tempfile; tempfile.tempdir = {str(temporary)!r}; Fence((), ('.',)).enter()"
    with pytest.raises(AssertionError, match="-9 == 0"):
        fenced(desk, f"{here}; Path(tempfile.gettempdir(), 'left').touch(); os.kill(os.getpid(), 9)")
    assert len(list(temporary.glob("*/left"))) == 1
    assert not other.exists()
    assert not fenced(desk, here)
    assert not list(temporary.iterdir())


def test_a_cache_that_cannot_be_used_is_replaced_by_one_that_is_found_again(desk: Path) -> None:
    (desk / "cache").write_text("")
    said = fenced(desk, """
        Fence().enter()
        folder = Path(os.environ["ROADGEO_CACHE"])
        (folder / "tried").write_text("")
        (folder / "tried").unlink()
        print(folder.name.startswith("roadgeo-"))
    """)  # fmt: skip
    assert said == "True"


def test_what_was_refused_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROADGEO_FENCED", "1")
    assert "--allow" in remedy("tile.tif: Permission denied")
    assert not remedy("no such file")
    monkeypatch.delenv("ROADGEO_FENCED")
    assert not remedy("tile.tif: Permission denied")


def test_where_there_is_no_landlock_nothing_changes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("roadgeo.storage.fence.abi_version", lambda: 0)
    assert not Fence((), (str(tmp_path / "new"),)).enter()
    assert not (tmp_path / "new").exists()
