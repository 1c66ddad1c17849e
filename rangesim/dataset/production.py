# SPDX-License-Identifier: Apache-2.0
"""Makes a data set: its scenes are the items of a campaign, whose results are packed into shards in their order.

The disk holds each scene once: as an item of the campaign until all scenes of its shard are there, and in the shard
from then on. Where a shard ends depends on the sizes of its scenes alone. So a run that was killed goes on, and ends
with the bytes of a run that was not.

A shard is valid from the moment when its rows are on the disk (`parts/000000.parquet`); its items are discarded after
that. At the end the parts become the index, and the checksums say that the data set is complete.
"""

from __future__ import annotations

import hashlib
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pcgraph.plumbing.plain_files import read_file, write_file
from rangesim.campaign import ItemStore, Outcome, QuarantinedItem, Workers, run_items
from rangesim.dataset.dataset_spec import DatasetSpec, spec_to_dict
from rangesim.dataset.random_scene import random_scene
from rangesim.dataset.sample import sample_bytes
from rangesim.dataset.sample_files import END_OF_TAR, SampleRecord, members_of, record_of, scene_key
from rangesim.dataset.store import (
    CHECKSUMS,
    INDEX,
    SETTINGS,
    IndexRow,
    Store,
    StoreRecord,
    model_path,
    parquet_bytes,
    parquet_metadata,
    read_rows,
    shard_path,
)
from rangesim.environment.versions import versions
from rangesim.errors import FileFormatError, RangesimWarning
from rangesim.files.schema import record_bytes
from rangesim.pipeline.stages import Progress

SHARD_BYTES = 128 << 20
"""Bytes from which on a shard is complete. Files of 100 MB and more are read at the full speed of disks and object
stores; the shard that is being packed lies in memory. Larger ones leave a loader with many processes fewer shards."""


def make_dataset(
    spec: DatasetSpec,
    directory: str | Path,
    workers: Workers | None = None,
    tell: Progress | None = None,
    retry: bool = False,
) -> Outcome:
    """Make a data set, or go on with one that was begun.

    Parameters
    ----------
    spec : what is drawn, and how many scenes.
    directory : folder of the data set, new, empty or begun with the same specification.
    workers : processes that compute the scenes; None: one for each core.
    tell : is called with what is done and with the fraction that is done, 0..1.
    retry : compute the scenes again that failed in an earlier run.

    Returns
    -------
    Outcome, with the scenes that failed. They stand in the index with their error.

    Raises
    ------
    FileFormatError
        The directory holds something else, or a data set of another specification or of other versions.
    EnvironmentProblem
        Workers cannot be reached, an extra is missing, or the disk is full. What is done is kept.

    Examples
    --------
    >>> from rangesim.dataset import load_spec, make_dataset
    >>> make_dataset(load_spec("bins.toml"), "out/bins")  # doctest: +SKIP
    """
    folder = Path(directory)
    with ItemStore(folder).claimed():
        _begin(spec, folder)
        packing = _Packing(spec, folder)
        if retry:
            packing.reopen()
        computed = 0
        if not Store(folder).is_complete:
            packing.advance()
            left = _Items(spec, packing.items.packed)
            computed = run_items(
                _scene_bytes, left, packing.items, workers, tell, lambda key: packing.advance(), retry
            ).computed
            packing.finish()
        packing.clear()
        rows = Store(folder).rows
        failed = [row for row in rows if row.error is not None]
        if empty := sum(row.objects == 0 for row in rows):
            warnings.warn(
                f"{empty} of {spec.scenes} scenes have no object; left_out in their records says why.",
                RangesimWarning,
                stacklevel=2,
            )
        quarantined = [
            QuarantinedItem(scene_key(row.scene), str(row.error), None, row.traceback or "") for row in failed
        ]
        return Outcome(computed, spec.scenes - computed - len(failed), tuple(quarantined))


def _scene_bytes(argument: tuple[DatasetSpec, int]) -> bytes:
    return sample_bytes(*argument)


class _Items(Mapping[str, tuple[DatasetSpec, int]]):
    """The arguments of the scenes from `first` on, by key."""

    def __init__(self, spec: DatasetSpec, first: int) -> None:
        self.spec, self.numbers = spec, range(first, spec.scenes)

    def __getitem__(self, key: str) -> tuple[DatasetSpec, int]:
        return self.spec, int(key)

    def __iter__(self) -> Iterator[str]:
        return map(scene_key, self.numbers)

    def __len__(self) -> int:
        return len(self.numbers)


def _begin(spec: DatasetSpec, folder: Path) -> None:
    """Write `store.json`, or check that it is that of the same data set."""
    wanted = StoreRecord(spec=spec_to_dict(spec), scenes=spec.scenes, tolerance_m=spec.tolerance_m, versions=versions())
    if not (folder / SETTINGS).exists():
        foreign = [each.name for each in folder.iterdir() if each.name != ".campaign.lock"]
        if foreign:
            raise FileFormatError(f"expected a new or an empty directory, but {folder} holds {foreign[0]!r}.")
        write_file(folder / SETTINGS, record_bytes(wanted), FileFormatError)
    found = Store(folder).record
    if found.spec != wanted.spec:
        keys = [key for key in {**wanted.spec, **found.spec} if wanted.spec.get(key) != found.spec.get(key)]
        raise FileFormatError(
            f"{folder} is a data set of another specification, different in {', '.join(keys)}; name another directory."
        )
    if found.versions != wanted.versions:
        other = [name for name in wanted.versions if found.versions.get(name) != wanted.versions[name]]
        was = ", ".join(f"{name} {found.versions.get(name)}" for name in other)
        raise FileFormatError(f"{folder} was begun with {was}; go on with these versions, or name another directory.")


class _Scenes(ItemStore):
    """The results of the campaign. It also holds those that were moved into shards, so none is computed again.

    packed : count of the scenes in complete shards. read_packed : function that returns the bytes of one of these.
    """

    def __init__(self, directory: Path, settings: Mapping[str, Any], read_packed: Callable[[int], bytes]) -> None:
        super().__init__(directory, settings)
        self.packed, self.read_packed = 0, read_packed

    def __contains__(self, key: str) -> bool:
        return int(key) < self.packed or super().__contains__(key)

    def read(self, key: str) -> bytes:
        return super().read(key) if super().__contains__(key) else self.read_packed(int(key))


class _Packing:
    """The shards of a data set that is being made.

    Attributes
    ----------
    items : the campaign's results.
    """

    def __init__(self, spec: DatasetSpec, folder: Path) -> None:
        self.spec, self.folder = spec, folder
        self.items = _Scenes(folder / "work", {"spec": spec_to_dict(spec)}, self._read_packed)
        self.parts = folder / "parts"
        self.shards = 0
        while self._part(self.shards).exists():
            rows = self._rows(self.shards)
            self._discard(rows)  # a run may have been killed before it did
            self.shards, self.items.packed = self.shards + 1, rows[-1].scene + 1
        self._start_shard()

    def _part(self, shard: int) -> Path:
        return self.parts / f"{shard:06d}.parquet"

    def _rows(self, shard: int) -> list[IndexRow]:
        """The rows of a complete shard."""
        return read_rows(read_file(self._part(shard), FileFormatError), str(self._part(shard)))

    def reopen(self) -> None:
        """Take scenes out of their shards, from the first shard on that has one that failed.

        They are items of the campaign then, and the next shards are made of them and of the scenes that are computed
        again. A run that is killed in between goes on with the shards that are left.
        """
        if Store(self.folder).is_complete:
            self._restore_parts()
        have_failed = [any(row.error is not None for row in self._rows(shard)) for shard in range(self.shards)]
        if True not in have_failed:
            return
        (self.folder / CHECKSUMS).unlink(missing_ok=True)
        arguments = _Items(self.spec, 0)
        while self.shards > have_failed.index(True):
            self.shards -= 1
            rows = self._rows(self.shards)
            for row in rows:
                if row.error is None:
                    key = scene_key(row.scene)
                    self.items.write(key, Store(self.folder).segment(row), arguments[key])
            self._part(self.shards).unlink()
            shard_path(self.folder, self.shards).unlink()
            self.items.packed = rows[0].scene
        self._start_shard()

    def _restore_parts(self) -> None:
        """Write the parts of a complete data set, of which the index was made."""
        store = Store(self.folder)
        sums = {name: sha256 for name, sha256 in store.checksums.items() if name.startswith("shards/")}
        of_shard: list[list[IndexRow]] = [[] for _ in sums]
        shard = len(sums) - 1
        for row in reversed(store.rows):  # one that failed belongs to the shard of the scene after it
            shard = shard if row.shard is None else row.shard
            of_shard[shard].insert(0, row)
        for shard, name in enumerate(sorted(sums)):
            part = parquet_bytes(of_shard[shard], {"shard_sha256": sums[name]})
            write_file(self._part(shard), part, FileFormatError, make_parents=True)
        self.shards, self.items.packed = len(sums), self.spec.scenes

    def _start_shard(self) -> None:
        self.next = self.items.packed
        self.segments: list[bytes] = []
        self.rows: list[IndexRow] = []
        self.size = 0

    def advance(self) -> None:
        """Take the scenes that follow and are there; each time enough are taken, they become a shard."""
        failed = None
        while self.next < self.spec.scenes:
            key = scene_key(self.next)
            if key in self.items:
                self._take(self.items.read(key))
            elif self.items.is_quarantined(key):
                failed = failed or {item.key: item for item in self.items.quarantined}
                item = failed[key]
                self.rows.append(IndexRow(scene=self.next, error=item.error, traceback=item.traceback))
            else:
                return
            self.next += 1
            if self.size >= SHARD_BYTES:
                self._close_shard()

    def _take(self, segment: bytes) -> None:
        place = f"scene {self.next}"
        record = record_of(members_of(segment, place), place)
        self._keep_models(record)
        self.rows.append(IndexRow.of(record, self.shards, self.size, segment))
        self.segments.append(segment)
        self.size += len(segment)

    def _keep_models(self, record: SampleRecord) -> None:
        """Write the meshes that come from files and that the store does not hold yet."""
        named = {each.sha256 for each in record.objects if each.from_file}
        missing = {sha256 for sha256 in named if not model_path(self.folder, sha256).exists()}
        for each in random_scene(self.spec, record.number).objects if missing else ():
            content = each.mesh.to_ply("part")
            sha256 = hashlib.sha256(content).hexdigest()
            if sha256 in missing:
                write_file(model_path(self.folder, sha256), content, FileFormatError, make_parents=True)
                missing.discard(sha256)

    def _close_shard(self) -> None:
        content = b"".join([*self.segments, END_OF_TAR])
        self.segments = []
        write_file(shard_path(self.folder, self.shards), content, FileFormatError, make_parents=True)
        part = parquet_bytes(self.rows, {"shard_sha256": hashlib.sha256(content).hexdigest()})
        write_file(self._part(self.shards), part, FileFormatError, make_parents=True)
        self.shards, self.items.packed = self.shards + 1, self.next
        self._discard(self.rows)
        self._start_shard()

    def _discard(self, rows: Sequence[IndexRow]) -> None:
        """Discard the results of scenes that are in a shard; those that failed stay until the end of the run."""
        for row in rows:
            if row.error is None:
                self.items.discard(scene_key(row.scene))

    def _read_packed(self, number: int) -> bytes:
        """The bytes of a scene that is in a shard."""
        for shard in range(self.shards):
            for row in self._rows(shard):
                if row.scene == number and row.error is None:
                    return Store(self.folder).segment(row)
        raise KeyError(scene_key(number))

    def finish(self) -> None:
        """Close the last shard, and write the index and the checksums."""
        self.advance()
        if self.next < self.spec.scenes:
            raise AssertionError(f"scene {self.next} is neither done nor failed")
        if self.rows:
            self._close_shard()
        rows, sums = [], {}
        for shard in range(self.shards):
            content = read_file(self._part(shard), FileFormatError)
            rows += read_rows(content, str(self._part(shard)))
            sums[f"shards/{shard:06d}.tar"] = parquet_metadata(content, str(self._part(shard)))["shard_sha256"]
        write_file(self.folder / INDEX, parquet_bytes(rows), FileFormatError)
        models = self.folder / "models"
        sums |= {f"models/{path.name}": path.stem for path in models.glob("*.ply")}
        for name in (INDEX, SETTINGS):
            sums[name] = hashlib.sha256(read_file(self.folder / name, FileFormatError)).hexdigest()
        lines = "".join(f"{sums[name]}  {name}\n" for name in sorted(sums))
        write_file(self.folder / CHECKSUMS, lines.encode(), FileFormatError)

    def clear(self) -> None:
        """Remove what is needed only while a data set is made."""
        for path in (self.parts, self.items.directory):
            shutil.rmtree(path, ignore_errors=True)
