"""README.md says what is true: its first commands are those that .ci/run runs, the others are ones that exist."""

import re
import shlex
from pathlib import Path

import click
import pytest

from roadgeo.cli import cli

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```bash\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)
COMMANDS = [
    line
    for document in (README, *(path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs").glob("*.md"))))
    for block in re.findall(r"^```bash\n(.*?)^```$", document, re.DOTALL | re.MULTILINE)
    for line in block.replace("\\\n", " ").splitlines()
    if line.startswith("roadgeo ")
]


def test_the_first_screen_holds_a_picture_and_two_commands() -> None:
    """One sets up and shows the main job, one sets up and tests; nothing more is asked of a newcomer."""
    picture = re.search(r"!\[.*\]\((.*\.png)\)", README)
    assert picture is not None
    assert (ROOT / picture[1]).stat().st_size < 300_000
    assert README[: README.index(BLOCKS[1])].count("\n") < 30
    for block, last in zip(BLOCKS[:2], ("roadgeo demo", "pytest"), strict=True):
        assert block.count("\n") == 1
        assert block.startswith("python3 -m venv .venv && .venv/bin/pip install ")
        assert block.rstrip().endswith(f".venv/bin/{last}")


def test_what_the_readme_links_to_is_there() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert target.startswith("https://") or (ROOT / target).exists(), target


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_and_option_exists(command: str) -> None:
    words = shlex.split(command.split(" > ")[0], comments=True)
    assert parse(words[1:]).info_name == words[1]


def parse(words: list[str]) -> click.Context:
    """Parse a command's options without running it."""
    command = cli.get_command(click.Context(cli), words[0])
    assert command is not None
    return command.make_context(words[0], words[1:])
