"""Pages of documentation as programs: their blocks, what running them gives, what they link to and name."""

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import click

from roadgeo.cli import cli, main

ROOT = Path(__file__).parents[2]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
INLINE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?")
OPTION = re.compile(r"(?<![\w-])--?[a-z][\w-]*")
#: What depends on the speed of the machine: the last column of `evaluate`'s tables.
MILLISECONDS = re.compile(r"\d+/\d+\s*$")
FILE = re.compile(r"[a-z0-9_./-]+\.(?:tif|gpkg|index|json|jsonl|geojson|png|html|csv|zip|kmz|points|txt|vrt|qml|tfw)")


@dataclass(frozen=True)
class Block:
    """What stands between fences: its language, its text, and the line of the page where it begins."""

    language: str
    text: str
    line: int

    def commands(self):
        """Yield (command, exit status) of each line; a comment "# status 3" says that it is not 0."""
        for line in self.text.replace("\\\n", " ").splitlines():
            reported = re.search(r"#.*\bstatus (\d+)", line)
            command = re.sub(r"\s+#.*$|^#.*$", "", line).strip()
            if command:
                yield command, int(reported[1]) if reported else 0


def blocks(text):
    """All fenced blocks of a page."""
    return [Block(found[1], found[2], text[: found.start()].count("\n") + 1) for found in FENCE.finditer(text)]


def prose(text):
    """The page without its fenced blocks."""
    return FENCE.sub("", text)


#: Numbers that pages write as words.
WORDS = {
    "half": 0.5,
    "a tenth": 0.1,
    "two thirds": 0.67,
    "two": 2,
    "three": 3,
    "four": 4,
    "five": 5,
    "six": 6,
    "eight": 8,
    "nine": 9,
    "ten": 10,
    "twenty": 20,
}


def said(page: str, sentence: str) -> tuple[str, ...]:
    """Return the groups of a pattern on a page, whose lines are joined."""
    found = re.search(sentence, " ".join((ROOT / page).read_text(encoding="utf-8").split()))
    assert found, f"{page} no longer says: {sentence}"
    return found.groups()


def value(text: str) -> float:
    """Return the number that a text is, in digits or a word."""
    return WORDS[text.lower()] if text.lower() in WORDS else float(text.replace(",", ""))


# --- running ----------------------------------------------------------------------------------------------------------


def run_page(text, servers=(), left_out=frozenset(), *, figures=False):
    """Run a page's bash and python blocks in order, in this folder; hold its text blocks against what was printed.

    With `figures` the numbers in them must be right, too, but for milliseconds.

    Raises AssertionError at what does not come out as the page says. `servers` are options that lead what is fetched
    to servers on loopback; `left_out` are the lines of blocks that are run elsewhere.
    """
    printed = ""
    names = {"__name__": "__page__"}
    for block in blocks(text):
        if block.line in left_out:
            continue
        if block.language == "bash":
            printed = "".join(run_command(*command, servers, block.line) for command in block.commands())
        elif block.language == "python":
            printed = run_program(block, names)
        elif block.language == "text":
            compare(block, printed, figures)


def run_program(block, names):
    """Run a python block in the names that those before it left, and return what it printed."""
    program = compile(block.text, f"<line {block.line}>", "exec")
    return captured(lambda: exec(program, names))[0]


def run_command(command, expected, servers=(), line=0):
    """Run one line of bash and return all it printed; roadgeo itself runs in this process."""
    assignments, words, rest = parse(command)
    if words[:1] == ["roadgeo"]:
        if words[1:2] == ["index"] and not {"--roads", "--source"} & set(words):
            words += servers
        before = {name: os.environ.get(name) for name in assignments}
        os.environ.update(assignments)
        try:
            printed, status, out = run_roadgeo(words[1:])
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.update({name: value})
        if rest:
            done = subprocess.run(["bash", "-c", rest], input=out, capture_output=True, text=True, check=False)
            printed += done.stdout + done.stderr
            status = status or done.returncode
    else:
        done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
        printed, status = done.stdout + done.stderr, done.returncode
    assert status == expected, f"line {line}: status {status}, not {expected}: {command}\n{printed}"
    return printed


def parse(command):
    """Split a line into assignments, the words of its first command, and a command that takes what that prints."""
    lexer = shlex.shlex(command, posix=True, punctuation_chars="|>")
    lexer.whitespace_split = True
    lexer.commenters = ""
    words = list(lexer)
    assignments = {}
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        name, _, value = words.pop(0).partition("=")
        assignments[name] = value
    at = next((i for i, word in enumerate(words) if word in {"|", ">", ">>"}), len(words))
    rest = ""
    if words[at:]:
        after = command.split(f" {words[at]} ", 1)[1]
        rest = after if words[at] == "|" else f"cat {words[at]} {after}"
    expanded = [
        name
        for word in words[:at]
        for name in (sorted(map(str, Path().glob(word))) or [word] if "*" in word else [word])
    ]
    return assignments, expanded, rest


def run_roadgeo(words):
    """Return what a command printed on both streams, its status, and what it printed on standard output."""
    if {"--jobs", "-j"} & set(words):  # a server of processes would outlive this page, and keep its environment
        command = [sys.executable, "-m", "roadgeo", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        return done.stdout + done.stderr, done.returncode, done.stdout
    status = 0

    def call():
        nonlocal status
        status = main(words)

    printed, out = captured(call)
    return printed, status, out


def captured(call):
    """Return (all that was printed, what was printed on standard output)."""
    both, out = io.StringIO(), io.StringIO()

    class Both(io.StringIO):
        def write(self, text):
            both.write(text)
            return out.write(text)

    with contextlib.redirect_stdout(Both()), contextlib.redirect_stderr(both):
        call()
    return both.getvalue(), out.getvalue()


def compare(block, printed, figures=False):
    """Hold a text block against what was printed: the same lines in the same order, but for numbers and gaps (...)."""
    lines = iter(printed.splitlines())
    for line in block.text.splitlines():
        wanted = normalise(line)
        if wanted in {"", "..."}:
            continue
        got = next((got for got in lines if wanted in normalise(got)), None)
        assert got is not None, f"line {block.line}: not printed: {line}\nbut\n{printed}"
        if figures:
            wrong = drifted(MILLISECONDS.sub("", line), got) if "recall" in block.text else drifted(line, got)
            assert not wrong, f"line {block.line}: {', '.join(wrong)} in: {line}\nbut printed: {got}"


def drifted(line, got):
    """Numbers of a line that differ from those that were printed, by more than a rebuilt machine or library makes."""
    before = normalise(got).index(normalise(line))
    skipped = normalise(got)[:before].count("#")
    wanted, found = NUMBER.findall(line), NUMBER.findall(got)[skipped:]
    return [f"{a} is {b} now" for a, b in zip(wanted, found, strict=False) if not alike(a, b)]


def alike(wanted, got):
    """Whether two numbers agree: those with four decimals and more are degrees, to 100 m; others to 5 %, or 2."""
    a, b = (float(text.replace(",", "")) for text in (wanted, got))
    exact = len(wanted.partition(".")[2]) >= 4
    return abs(a - b) <= (0.001 if exact else max(2.0, 0.05 * abs(a)))


def normalise(line):
    """Leave out what differs from run to run: numbers, and spaces that fill up."""
    return " ".join(re.sub(r"[─-]{2,}", "-", NUMBER.sub("#", line)).split())


# --- what is named ----------------------------------------------------------------------------------------------------


def context(words):
    """The click command that words begin with, and the words after its name."""
    command, rest = cli, list(words)
    while isinstance(command, click.Group) and rest and not rest[0].startswith("-"):
        found = command.get_command(click.Context(command), rest[0])
        if found is None:
            return None, rest
        command, rest = found, rest[1:]
    return command, rest


def options_of(command):
    """All options of a command."""
    known = {"-h", "--help"}
    for parameter in command.params:
        if isinstance(parameter, click.Option):
            known |= {*parameter.opts, *parameter.secondary_opts}
    return known


def commands(command=cli, name=""):
    """Yield every command, groups too, with its name."""
    yield name, command
    if isinstance(command, click.Group):
        for part in command.list_commands(click.Context(command)):
            yield from commands(command.get_command(click.Context(command), part), f"{name} {part}".strip())


def unknown_names(text):
    """Commands and options that a page names, in blocks or inline, and that the command line does not have."""
    wrong = []
    known = {option for _, command in commands() for option in options_of(command)}
    lines = [command for block in blocks(text) if block.language == "bash" for command, _ in block.commands()]
    for code in [*INLINE.findall(prose(text)), *lines]:
        words = code.split()
        if words[:1] == ["roadgeo"] and len(words) > 1 and not words[1].isupper():
            command, rest = context(words[1:])
            has = options_of(command) if command else set()
            wrong += [f"{code}: {item}" for item in OPTION.findall(" ".join(rest)) if item not in has]
            wrong += [] if command else [code]
        elif words and words[0].startswith("-"):
            wrong += [item for item in OPTION.findall(code) if item not in known]
    return wrong


def broken_links(page, text):
    """Relative links and pictures of a page that lead nowhere."""
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(text)):
        if target.startswith(("https://", "mailto:")):
            continue
        path, _, anchor = target.partition("#")
        aim = (page.parent / path).resolve() if path else page
        if not aim.exists() or (anchor and anchor not in anchors(aim.read_text(encoding="utf-8") if path else text)):
            broken.append(target)
    return broken


def anchors(text):
    """What the headings of a page are called in links, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)$", prose(text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def missing_files(text, folder):
    """Files that a page names inline and that are neither in a folder nor in the repository."""
    there = {str(path.relative_to(folder)) for path in folder.rglob("*")}
    named = {code for code in INLINE.findall(prose(text)) if FILE.fullmatch(code)}
    return sorted(
        name
        for name in named
        if not (ROOT / name).exists() and not any(f"/{item}".endswith(f"/{name}") for item in there)
    )
