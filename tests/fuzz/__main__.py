# SPDX-License-Identifier: Apache-2.0
"""``python -m fuzz``: any number of cases over all readers, or one again; `make fuzz N=...` calls it."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from fuzz.campaign import Tally, Watch, load_seeds, read_kept, run, table
from fuzz.inputs import dumps, to_json
from fuzz.readers import READERS, Cases


def main() -> int:
    """Exit status 1 if anything failed."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--n", type=int, default=10_000, help="tries in total over all readers")
    parser.add_argument("--seed", type=int, default=0, help="stream of cases; the same one gives the same bytes")
    parser.add_argument("--reader", default="", help="one reader, or several with commas; default: all")
    parser.add_argument("--case", type=int, help="one case again, by its number")
    parser.add_argument("--kept", type=Path, help="one file of the corpus again")
    parser.add_argument("--jobs", type=int, default=1, help="readers at the same time")
    parser.add_argument("--keep", action="store_true", help="minimise new failures and write them to the corpus")
    parser.add_argument("--json", type=Path, help="write the failures, grouped, to this file")
    parser.add_argument("--write", type=Path, help="with --case: write the input to this new directory")
    given = parser.parse_args()
    names = given.reader.split(",") if given.reader else list(READERS)
    if unknown := [name for name in names if name not in READERS]:
        parser.error(f"unknown reader {unknown[0]!r}; there are {', '.join(READERS)}")
    if given.case is not None or given.kept is not None:
        return _again(names[0], given.seed, given.case, given.kept, given.write)
    tallies = run(given.n, given.seed, names, given.jobs, given.keep)
    print(table(tallies))
    _print_failures(tallies, given.seed)
    if given.json is not None:
        found = [asdict(group) for tally in tallies for group in tally.groups.values()]
        given.json.write_text(json.dumps(found, indent=1) + "\n")
    return int(any(tally.groups for tally in tallies))


def _again(reader: str, seed: int, number: int | None, path: Path | None, write: Path | None) -> int:
    """Replay one case and print what became of it."""
    folder = Path(tempfile.mkdtemp(prefix="rangesim-fuzz-seeds-"))
    try:
        with Watch(folder / "seeds.pickle") as watch:
            watch.start()
            seeds = load_seeds(folder / "seeds.pickle")
            if path is not None:
                reader, one = read_kept(path, seeds)
            else:
                one = Cases(READERS[reader], seeds[reader])(seed, number or 0)
            answer = watch.answer(reader, one)
    finally:
        shutil.rmtree(folder)
    text = dumps(to_json(one, seeds[reader]))
    print(text if len(text) < 4000 else text[:4000] + " ...")
    for name, value in asdict(answer).items():
        print(f"{name:<8} {value}")
    if write is not None:
        write.mkdir(parents=True)
        print(f"written  {one.write(write)}")
    return int(answer.outcome == "failed")


def _print_failures(tallies: list[Tally], seed: int) -> None:
    for tally in tallies:
        for group in sorted(tally.groups.values(), key=lambda g: -g.count):
            answer = group.answer
            print(f"\n{group.count} x {group.reader}: {answer.kind} {answer.error} at {answer.place}")
            print(f"    {group.name}: --reader {group.reader} --seed {seed} --case {group.case} {group.kept}")
            print(f"    {answer.message[:200]!a}")
            print(f"    {group.example[:200]!a}")


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    sys.exit(status)
