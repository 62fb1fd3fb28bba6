"""Count odd words and long sentences in prose: python .ci/prose.py [--limits] [--allow NAME=RATE] [--show] PATH...

Prose is what docstrings and comments of Python files hold, and Markdown without its code, tables and quotations of
output. Names that mean anything are counted in the code. Counts are per 1,000 lines. With `--limits` the exit status is
1 where a count is above its limit, or a Markdown file has a sentence that is too long; `--allow` raises a limit.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

#: What is counted, and how often it may stand in 1,000 lines.
COUNTED = {
    "say, tell": (re.compile(r"\b(?:say|says|said|saying|tell|tells|told|telling)\b", re.IGNORECASE), 6.0),
    "so many, so much": (re.compile(r"\bso (?:many|much|few|little|large|long|often|far)\b", re.IGNORECASE), 2.0),
    "what (as a noun)": (
        re.compile(r"(?:^|[.;:,(] |\b(?:of|for|from|with|by|at|on|than|and) )what\b", re.IGNORECASE),
        6.0,
    ),
    "that of, those of": (re.compile(r"\b(?:that|those) of\b", re.IGNORECASE), 1.0),
    "Of ...": (re.compile(r"(?:^|[.!?:;] |^\W+)Of\b"), 0.5),
    "is none": (re.compile(r"\b(?:is|are|was|were) none\b"), 1.0),
}
#: Identifiers that mean anything, and how often they may stand in 1,000 lines of Python.
NAMES = {"told": 0.0, "one": 3.0}
#: Words of a sentence in Markdown.
LONGEST = 35


def prose_of_python(text: str) -> Iterator[str]:
    """Yield the lines of docstrings and comments, without code and names of parameters."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (ast.get_docstring(node) or "").splitlines()
            yield from (re.sub(r"`[^`]*`", "`", line) for line in lines if not re.match(r"\s*\w+( : .*)?$", line))
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and not re.match(r"#\s*(?:noqa|type:|pragma|!|-{3})", token.string):
            yield token.string.lstrip("#: ")


def names_of_python(text: str) -> Counter[str]:
    """Count the identifiers of a module that mean anything."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return Counter(token.string for token in tokens if token.type == tokenize.NAME and token.string in NAMES)


def paragraphs(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line, text) of the paragraphs, items and headings of Markdown, without code and tables."""
    text = re.sub(
        r"^( *)(```|~~~).*?^\1\2\s*$", lambda found: "\n" * found[0].count("\n"), text, flags=re.DOTALL | re.MULTILINE
    )
    start, lines = 0, []
    for number, line in enumerate([*text.splitlines(), ""], 1):
        fresh = re.match(r"\s*(?:[-*+]|\d+\.)\s|#", line)
        if lines and (fresh or not line.strip() or line.lstrip().startswith("|")):
            yield start, " ".join(lines)
            lines = []
        if line.strip() and not line.lstrip().startswith(("|", "<!--", "    ")):
            start = start if lines else number
            lines.append(line.strip())


def prose_of_markdown(text: str) -> Iterator[str]:
    """Yield the lines of its paragraphs, 100 characters each."""
    for _, paragraph in paragraphs(text):
        yield from re.findall(r".{1,100}(?:\s|$)", paragraph)


def long_sentences(text: str) -> Iterator[tuple[int, int, str]]:
    """Yield (line, words, sentence) of the sentences of Markdown that are too long; inline code is one word."""
    for line, paragraph in paragraphs(text):
        plain = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", paragraph)  # the description of a picture
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", plain)  # the text of a link counts, its target does not
        plain = re.sub(r"`[^`]*`", "Code", plain)
        for sentence in re.split(r"(?<=[.!?:])[)*\"”]*\s+(?=[\"'(*]*[A-Z0-9])", plain):
            words = re.findall(r"[A-Za-z][\w'’-]*", sentence)
            if len(words) > LONGEST:
                yield line, len(words), sentence


def find_files(paths: Iterable[str]) -> list[Path]:
    """Find Python and Markdown files in folders."""
    found = []
    for path in map(Path, paths):
        files = path.rglob("*") if path.is_dir() else [path]
        found += sorted(file for file in files if file.suffix in {".py", ".md"})
    return found


def main() -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+")
    parser.add_argument("--limits", action="store_true")
    parser.add_argument("--allow", action="append", default=[], metavar="NAME=RATE")
    parser.add_argument("--names", action="store_true", help="count names in the code alone")
    parser.add_argument("--show", action="store_true", help="print each line that counts")
    args = parser.parse_args()
    allowed = {name: float(rate) for name, _, rate in (text.rpartition("=") for text in args.allow)}
    lines: list[str] = []
    names: Counter[str] = Counter()
    n_code = bad = 0
    for path in find_files(args.paths):
        text = path.read_text("utf-8")
        own = [
            line
            for line in (prose_of_python if path.suffix == ".py" else prose_of_markdown)(text)
            if re.search("[a-z]", line)
        ]
        lines += own
        if path.suffix == ".py":
            n_code += len(text.splitlines())
            names += names_of_python(text)
        if args.show:
            sys.stdout.writelines(
                f"{path}: {line.strip()}\n" for line in own if any(e.search(line) for e, _ in COUNTED.values())
            )
        if path.suffix == ".md" and not args.names:
            for line, words, sentence in long_sentences(text):
                bad += 1
                sys.stdout.write(f"{path}:{line}: a sentence of {words} words: {sentence[:90]} ...\n")
    sys.stdout.write(f"{len(lines)} lines of prose\n")
    counted = [
        (name, sum(len(pattern.findall(line)) for line in lines), len(lines), limit)
        for name, (pattern, limit) in COUNTED.items()
        if not args.names
    ]
    counted += [(name, names[name], n_code, limit) for name, limit in NAMES.items()]
    for name, count, n_lines, limit in counted:
        most = allowed.get(name, limit)
        rate = 1000 * count / max(n_lines, 1)
        bad += rate > most
        sys.stdout.write(f"{name:20} {count:5} {rate:6.1f} per 1,000 lines, limit {most:g}\n")
    return int(args.limits and bad > 0)


if __name__ == "__main__":
    sys.exit(main())
