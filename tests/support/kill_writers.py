"""Kill a writer of references at random moments; the reference must stay whole, and nothing may be left over.

    python tests/support/kill_writers.py [--count 100] [--seed 0] [-- COMMAND ...]

A writer replaces one reference by another again and again, and is killed (SIGKILL) at a random moment. Then the
reference must be one of the two, with its own index or with none, in which case the index is built from the GeoPackage.
With a COMMAND (such as `roadgeo index --roads R.gpkg --out REF.gpkg --replace`; the word REF stands for the
reference) that is killed instead. The last, undisturbed writer must leave two files and nothing else.
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # run as a program, this file finds `worlds` beside its folder

from worlds.networks import grid_network

from roadgeo.reference.files import open_reference, write_reference
from roadgeo.reference.inspection import check_reference
from roadgeo.reference.network_file import network_digest, read_network
from roadgeo.roads.network import RoadNetwork, as_stored

SIZES = (6, 16)


def parts(network: RoadNetwork) -> tuple[dict[str, Any], dict[str, Any]]:
    """Stand in for an index: that is not what is tested here."""
    found = network.intersections
    return {"n": len(found)}, {"xy": found.xy, "rays": found.rays}


def write_for_ever(path: Path) -> None:
    """Replace a reference by another of a different size, again and again."""
    networks = [as_stored(grid_network(size, size, seed=size)) for size in SIZES]
    while True:
        for network in networks:
            write_reference(path, network, parts(network))
            print("written", flush=True)


def read_for_ever(path: Path) -> None:
    """Open a reference again and again until told to stop; print how often what was torn, and each size, was met."""
    known = {len(xy): xy for xy in (as_stored(grid_network(size, size, seed=size)).intersections.xy for size in SIZES)}
    met = dict.fromkeys([0, *known], 0)
    print("reading", flush=True)
    while not path.with_name("stop").exists():
        meta, arrays = open_reference(path, parts)
        whole = meta["n"] in known and np.array_equal(arrays["xy"], known[meta["n"]])
        met[meta["n"] if whole else 0] += 1
    print(*met.values(), flush=True)


def kill_own_writer(path: Path, rng: random.Random) -> None:
    """Start a writer, let it write once, kill it somewhere in what follows."""
    command = [sys.executable, __file__, "--write", str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        time.sleep(rng.uniform(0, 0.15))
        writer.send_signal(signal.SIGKILL)


def kill_command(command: list[str], longest: float, rng: random.Random) -> None:
    """Start a command and kill it somewhere within `longest` seconds."""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as writer:
        time.sleep(rng.uniform(0, longest))
        writer.send_signal(signal.SIGKILL)


def names(folder: Path) -> list[str]:
    """Everything in a folder."""
    return sorted(path.name for path in folder.iterdir())


def state_of(path: Path, digests: set[str]) -> str:
    """Open what a killed writer left; which of the legal states it is."""
    had_index = path.with_suffix(".index").exists()
    network = read_network(path)
    assert network_digest(network) in digests
    meta, arrays = open_reference(path, parts)
    if not had_index:
        assert meta == {"n": len(network.intersections)}
        assert len(arrays["xy"]) == meta["n"]
    return "whole" if had_index else "index built again"


def run_own(folder: Path, count: int, rng: random.Random) -> dict[str, int]:
    """Kill our own writer `count` times."""
    path = folder / "REF.gpkg"
    networks = [as_stored(grid_network(size, size, seed=size)) for size in SIZES]
    digests = {network_digest(network) for network in networks}
    states = {"whole": 0, "index built again": 0, "with leftovers": 0}
    for _ in range(count):
        kill_own_writer(path, rng)
        states["with leftovers"] += len(names(folder)) > 2
        states[state_of(path, digests)] += 1
    write_reference(path, networks[0], parts(networks[0]))
    return states


def run_command(folder: Path, command: list[str], count: int, rng: random.Random) -> dict[str, int]:
    """Kill a command `count` times, then let it finish."""
    path = folder / "REF.gpkg"
    command = [word.replace("REF", str(folder / "REF")) for word in command]
    start = time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    longest = 1.1 * (time.monotonic() - start)
    digests = {network_digest(read_network(path))}
    states = {"whole": 0, "index built again": 0, "with leftovers": 0}
    for _ in range(count):
        kill_command(command, longest, rng)
        states["with leftovers"] += len(names(folder)) > 2
        states[state_of(path, digests)] += 1
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert check_reference(path) == []
    return states


def run(count: int, seed: int, command: list[str]) -> dict[str, int]:
    """Kill `count` writers; how often each legal state was found."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        states = run_command(folder, command, count, rng) if command else run_own(folder, count, rng)
        assert names(folder) == ["REF.gpkg", "REF.index"], names(folder)
    return states


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("command", nargs="*")
    options = parser.parse_args()
    if options.read:
        read_for_ever(options.read)
        return
    if options.write:
        write_for_ever(options.write)
    print(json.dumps(run(options.count, options.seed, options.command)))


if __name__ == "__main__":
    main()
