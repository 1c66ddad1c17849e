# SPDX-License-Identifier: Apache-2.0
"""Every reader on damaged, lying and hostile files: an answer or one sentence, soon, in little memory, no litter."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from fuzz.campaign import CORPUS, Watch, fuzz_reader, kept, load_seeds, minimise, read_kept, shares, table
from fuzz.inputs import Input, from_json, to_json
from fuzz.readers import READERS, Cases

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory and open files are watched through /proc")

TRIES = 60
"""Over all readers, besides what is made by hand; `make fuzz N=...` does more. Scenes and commands get fewer."""
SEED = 1
EVERY = 6
"""Commands get one in so many of the inputs made by hand: the readers that they call are given all of them."""
NAMED = "compare"
"""The command that gets all hostile names: how files are named in what is printed is the same in every command."""
Seeds = Mapping[str, Mapping[str, Input]]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz") / "seeds.pickle"


@pytest.fixture(scope="module")
def watch(store: Path) -> Iterator[Watch]:
    with Watch(store) as one:
        one.start()
        yield one


@pytest.fixture(scope="module")
def seeds(watch: Watch, store: Path) -> Seeds:
    return load_seeds(store)


@pytest.mark.parametrize("name", READERS)
def test_seeds_are_accepted(name: str, watch: Watch, seeds: Seeds) -> None:
    for key, seed in seeds[name].items():
        answer = watch.answer(name, seed)
        assert answer.outcome == "accepted", f"{key}: {answer}"


def numbers(cases: Cases) -> list[int]:
    """Of the cases of a reader those that are tried: all made by hand, of a command on files every sixth, and more."""
    reader, names = cases.reader, list(cases.by_hand)
    chosen = list(range(len(names)))
    if reader.command and not reader.mutates_arguments:
        chosen = [k for k in chosen if k % EVERY == 0 or (reader.name == NAMED and names[k].startswith("name "))]
    return [*chosen, *range(len(names), len(names) + shares(TRIES, READERS)[reader.name])]


@pytest.mark.parametrize("name", READERS)
def test_reader_answers(name: str, watch: Watch, seeds: Seeds) -> None:
    """All that is made by hand, for commands on files a sixth of it: `python -m fuzz` gives them the rest, too."""
    cases = Cases(READERS[name], seeds[name])
    tally = fuzz_reader(watch, cases, numbers(cases), SEED)
    lines = [
        f"{group.count} x {' '.join(group.answer.group)}: {group.name} "
        f"(python -m fuzz --reader {name} --seed {SEED} --case {group.case}): {group.answer.message[:200]!r}"
        for group in tally.groups.values()
    ]
    assert not lines, "\n".join([table([tally]), *lines])


@pytest.mark.parametrize("path", kept(), ids=lambda p: str(p.relative_to(CORPUS)))
def test_kept_failures_are_answered(path: Path, watch: Watch, seeds: Seeds) -> None:
    name, one = read_kept(path, seeds)
    answer = watch.answer(name, one)
    assert answer.outcome in ("accepted", "refused"), answer


# --- the harness itself -----------------------------------------------------------------------------------------------


def test_a_case_is_the_same_bytes_always(seeds: Seeds) -> None:
    for name, reader in READERS.items():
        one, other = Cases(reader, seeds[name]), Cases(reader, seeds[name])
        for number in range(len(one.by_hand), len(one.by_hand) + 20):
            assert one(7, number) == other(7, number)


def test_kept_inputs_come_back(seeds: Seeds) -> None:
    for name, reader in READERS.items():
        cases = Cases(reader, seeds[name])
        for number in range(len(cases.by_hand), len(cases.by_hand) + 20):
            one = cases(7, number)
            assert from_json(to_json(one, seeds[name]), seeds[name]) == one


def test_the_corpus_is_small() -> None:
    assert sum(path.stat().st_size for path in kept()) < 1_000_000


def test_minimising_leaves_what_matters(seeds: Seeds) -> None:
    whole = b"".join(b"%d\n" % i for i in range(500))
    one = Input({"a.ply": whole}, "a.ply")
    smaller = minimise(one, {}, lambda c: b"137" in c.files["a.ply"])  # type: ignore[operator]
    assert smaller.files["a.ply"] == b"137"
    result = seeds["result-range"]["result"]
    changed = result.with_file("result/ideal/range.npz", b"ZEBRA" * 9).with_file("result/pass_1.npz", b"y" * 50)
    smaller = minimise(changed, {"result": result}, lambda c: b"ZEBRA" in c.files["result/ideal/range.npz"])  # type: ignore[operator]
    assert smaller == result.with_file("result/ideal/range.npz", b"ZEBRA")


BROKEN = {
    "raise KeyError('x')": ("exception", "KeyError"),
    "raise ValueError('two\\nlines')": ("message", "ValueError: not one printable line"),
    "raise ValueError('about nothing')": ("message", "ValueError: does not name the file"),
    "raise ValueError(f'{path} ' + 'x' * 600)": ("message", "ValueError: longer than 500 characters"),
    "print('hello')": ("output", ""),
    "import os; os.write(2, b'hello')": ("output", ""),
    "import warnings; warnings.warn('hello')": ("warning", "UserWarning"),
    "kept = open(path)": ("leak", "open file"),
    "import tempfile; tempfile.mkstemp()[0]": ("leak", "open file"),
    "import tempfile, os; os.close(tempfile.mkstemp()[0])": ("leak", "temporary file"),
    "path.with_name('other').touch()": ("leak", "file"),
    "bytearray(1_200_000_000)": ("exception", "MemoryError"),
    "import sys; sys.exit(3)": ("exception", "SystemExit"),
    "import os; os.kill(os.getpid(), 11)": ("crash", "signal 11"),
    "assert False": ("exception", "AssertionError"),
}


@pytest.mark.parametrize("code", BROKEN)
def test_a_broken_reader_is_found_out(code: str, watch: Watch) -> None:
    answer = watch.answer("self-test", Input({"code.py": code.encode()}, "code.py"))
    assert (answer.outcome, answer.kind, answer.error) == ("failed", *BROKEN[code])


def test_a_hanging_reader_is_found_out(store: Path, seeds: Seeds) -> None:
    with Watch(store, limit_s=1.0) as impatient:
        answer = impatient.answer("self-test", Input({"code.py": b"while True: pass"}, "code.py"))
        assert (answer.outcome, answer.kind) == ("failed", "late")
        assert impatient.answer("self-test", Input({"code.py": b"pass"}, "code.py")).outcome == "accepted"


@pytest.mark.parametrize(
    ("code", "outcome"), [("pass", "accepted"), ("raise ValueError(f'expected better, got {path}.')", "refused")]
)
def test_a_sound_reader_is_not(code: str, outcome: str, watch: Watch) -> None:
    assert watch.answer("self-test", Input({"code.py": code.encode()}, "code.py")).outcome == outcome
