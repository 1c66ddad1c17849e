# SPDX-License-Identifier: Apache-2.0
"""The directory of a data set: shards of scenes, an index with a row for each scene, and the models of the objects.

DIR/store.json           the specification, the count of scenes, and the versions that made them
    shards/000000.tar    scenes one after the other (`rangesim.dataset.sample_files`), which WebDataset reads, too
    index.parquet        a row for each scene, also for those that failed
    models/SHA256.ply    each mesh that comes from a file, once: metres, coordinates of the part
    checksums.txt        SHA-256 of every file above, as `sha256sum -c` reads it; it is written last
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

from pcgraph.plumbing.plain_files import read_file
from rangesim.dataset.sample_files import SampleRecord, members_of, mesh_in
from rangesim.errors import EnvironmentProblem, FileFormatError
from rangesim.evaluation.surface_rows import OBJECTS
from rangesim.files.schema import Count, Positive, Record, read_record
from rangesim.results.experiment_results import RowRecord
from rangesim.triangle_mesh import TriangleMesh

SETTINGS, INDEX, CHECKSUMS = "store.json", "index.parquet", "checksums.txt"
"""Names of the single files of a store."""


class StoreRecord(Record, frozen=True, kw_only=True):
    """The contents of `store.json`.

    spec : plain data of the specification. scenes : count of scenes. tolerance_m : largest error of a right reading,
    metres. versions : of the packages on which bytes depend.
    """

    format: Literal["rangesim-dataset"] = "rangesim-dataset"
    format_version: Literal[1] = 1
    spec: dict[str, Any]
    scenes: Count
    tolerance_m: Positive
    versions: dict[str, str]


@dataclass(frozen=True)
class IndexRow:
    """The row of a scene in the index.

    scene : its number. shard, offset, size : where its bytes are; None for a scene that failed.
    sha256 : of these bytes. seed : of its light and noise.
    objects : their count. categories : of the objects, each once.
    sensors : their names. right, wrong, missing : of each sensor, fractions of the pixels of objects, each of which
        weighs the same; if no object is seen, of all pixels that see a surface, or None if none does.
    error, traceback : why the scene failed; None for all others.
    """

    scene: Count
    shard: Count | None = None
    offset: Count | None = None
    size: Count | None = None
    sha256: str | None = None
    seed: int | None = None
    objects: Count | None = None
    categories: Sequence[str] = ()
    sensors: Sequence[str] = ()
    right: Sequence[float | None] = ()
    wrong: Sequence[float | None] = ()
    missing: Sequence[float | None] = ()
    error: str | None = None
    traceback: str | None = None

    @property
    def place(self) -> tuple[int, int, int]:
        """Shard, offset and size of the scene's bytes; ValueError for a scene that failed."""
        if self.shard is None or self.offset is None or self.size is None:
            raise ValueError(f"expected a scene that did not fail, but scene {self.scene} did: {self.error}")
        return self.shard, self.offset, self.size

    @classmethod
    def of(cls, record: SampleRecord, shard: int, offset: int, segment: bytes) -> IndexRow:
        """The row of a scene whose bytes stand at an offset of a shard."""
        rows = [_verdict(sensor.rows) for sensor in record.sensors]
        return cls(
            scene=record.number,
            shard=shard,
            offset=offset,
            size=len(segment),
            sha256=hashlib.sha256(segment).hexdigest(),
            seed=record.seed,
            objects=len(record.objects),
            categories=sorted({each.category for each in record.objects}),
            sensors=[sensor.name for sensor in record.sensors],
            right=[row.right for row in rows],
            wrong=[row.wrong for row in rows],
            missing=[row.missing for row in rows],
        )


def _verdict(rows: Sequence[RowRecord]) -> RowRecord:
    """The row of the mean over objects; that of all surfaces if no object is seen."""
    return next((row for row in rows if row.kind == OBJECTS), rows[-1])


class Store:
    """A data set on the disk, complete or still being made.

    Parameters
    ----------
    directory : its folder.

    Raises
    ------
    FileFormatError
        The directory holds no data set, or `store.json` is broken.

    What is read of a complete data set is compared with its checksums first, so a file that was changed is refused.

    Examples
    --------
    >>> store = Store("out/bins")  # doctest: +SKIP
    >>> store.rows[0].right  # of each sensor  # doctest: +SKIP
    """

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(directory)
        if not (self.directory / SETTINGS).is_file():
            raise FileFormatError(
                f"expected a data set of `rangesim dataset`, got {directory}, which has no {SETTINGS}."
            )
        self.record = read_record(self.directory / SETTINGS, StoreRecord)

    @property
    def is_complete(self) -> bool:
        """Whether all scenes are there."""
        return (self.directory / CHECKSUMS).is_file()

    @property
    def checksums(self) -> dict[str, str]:
        """SHA-256 of each file by its name, as `checksums.txt` lists them; FileFormatError if that file is broken."""
        path = self.directory / CHECKSUMS
        lines = read_file(path, FileFormatError).decode(errors="replace").split("\n")
        found = [re.fullmatch(r"([0-9a-f]{64})  (\S+)", line) for line in lines[:-1]]
        listed = {match[2]: match[1] for match in found if match}
        if len(listed) < len(found) or lines[-1] or not {INDEX, SETTINGS} <= listed.keys():
            raise FileFormatError(f"{path} is broken: expected a checksum for each file, {INDEX} and {SETTINGS} too.")
        return listed

    @property
    def rows(self) -> list[IndexRow]:
        """The rows of the index, scene by scene.

        Raises
        ------
        FileFormatError
            The data set is not complete, or its index is broken.
        """
        if not self.is_complete:
            raise FileFormatError(f"{self.directory} is not complete; run `rangesim dataset make` again to go on.")
        listed = self.checksums
        contents = {name: read_file(self.directory / name, FileFormatError) for name in (SETTINGS, INDEX)}
        for name, content in contents.items():
            if hashlib.sha256(content).hexdigest() != listed[name]:
                raise FileFormatError(f"{self.directory / name} was changed: its checksum is not that in {CHECKSUMS}.")
        return read_rows(contents[INDEX], str(self.directory / INDEX))

    def members(self, row: IndexRow) -> dict[str, bytes]:
        """The members of a scene by suffix, see `rangesim.dataset.sample_files`; FileFormatError if they are broken."""
        return members_of(self.segment(row), self.place(row))

    def segment(self, row: IndexRow) -> bytes:
        """The bytes of a scene; FileFormatError if they are missing or changed."""
        shard, offset, size = row.place
        path = shard_path(self.directory, shard)
        try:
            with path.open("rb") as file:
                file.seek(offset)
                content = file.read(size)
        except OSError as problem:
            raise FileFormatError(f"cannot read {path}: {problem.strerror or problem}.") from problem
        if len(content) < size:
            raise FileFormatError(f"{path} ends early, within scene {row.scene}.")
        if hashlib.sha256(content).hexdigest() != row.sha256:
            raise FileFormatError(f"{path}, scene {row.scene}: its bytes are not those that the index lists.")
        return content

    def place(self, row: IndexRow) -> str:
        """Place of a scene in its shard, for messages."""
        return f"{shard_path(self.directory, row.place[0])}, scene {row.scene}"

    def mesh(self, record: SampleRecord, index: int, members: Mapping[str, bytes]) -> TriangleMesh:
        """The mesh of an object of a scene, metres, coordinates of the part; FileFormatError if it is broken.

        index : of the object in `record.objects`. members : those of the scene.
        """
        each = record.objects[index]
        if each.from_file:
            path = model_path(self.directory, each.sha256)
            if hashlib.sha256(read_file(path, FileFormatError)).hexdigest() != each.sha256:
                raise FileFormatError(f"{path} was changed: its checksum is not its name.")
            return TriangleMesh.load(path)
        return mesh_in(members, index, f"scene {record.number}")


def shard_path(directory: Path, number: int) -> Path:
    """Path of a shard of a store."""
    return directory / "shards" / f"{number:06d}.tar"


def model_path(directory: Path, sha256: str) -> Path:
    """Path of a model of a store."""
    return directory / "models" / f"{sha256}.ply"


# ---- The index -----------------------------------------------------------------------------------------------------


def parquet_bytes(rows: Sequence[IndexRow], metadata: Mapping[str, str] | None = None) -> bytes:
    """The bytes of a Parquet file with these rows."""
    pa = _pyarrow()
    import pyarrow.parquet as pq

    kinds = {"int64": ("scene", "offset", "size"), "int32": ("shard", "objects"), "uint64": ("seed",)}
    kinds |= {"string": ("sha256", "error", "traceback")}
    columns = {name: getattr(pa, kind)() for kind, names in kinds.items() for name in names}
    columns |= dict.fromkeys(("categories", "sensors"), pa.list_(pa.string()))
    columns |= dict.fromkeys(("right", "wrong", "missing"), pa.list_(pa.float64()))
    fields = [(name, columns[name]) for name in IndexRow.__dataclass_fields__]
    schema = pa.schema(fields, metadata=dict(metadata or {}))
    buffer = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist([vars(row) for row in rows], schema=schema), buffer, compression="zstd")
    return bytes(buffer.getvalue())


def read_rows(content: bytes, place: str) -> list[IndexRow]:
    """The rows of a Parquet file that `parquet_bytes` made; FileFormatError if it is broken."""
    try:
        rows = msgspec.convert(_table(content, place).to_pylist(), list[IndexRow])
    except msgspec.ValidationError as error:
        raise FileFormatError(f"{place} is broken: {error}.") from error
    for row in rows:
        if row.error is None and None in (row.shard, row.offset, row.size):
            raise FileFormatError(f"{place}: expected a place or an error of scene {row.scene}.")
        if not len(row.sensors) == len(row.right) == len(row.wrong) == len(row.missing):
            raise FileFormatError(f"{place}: expected fractions of {len(row.sensors)} sensors of scene {row.scene}.")
    return rows


def parquet_metadata(content: bytes, place: str) -> dict[str, str]:
    """The metadata that `parquet_bytes` was given."""
    return {k.decode(): v.decode() for k, v in (_table(content, place).schema.metadata or {}).items()}


def _table(content: bytes, place: str) -> Any:
    pa = _pyarrow()
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(pa.BufferReader(content))
    except (pa.ArrowInvalid, OSError) as error:
        raise FileFormatError(f"{place} is no Parquet file: {error}.") from error
    if table.column_names != list(IndexRow.__dataclass_fields__):
        raise FileFormatError(f"{place}: expected the columns {', '.join(IndexRow.__dataclass_fields__)}.")
    return table


def _pyarrow() -> Any:
    try:
        import pyarrow
    except ImportError:
        raise EnvironmentProblem(
            "the index of a data set needs pyarrow, which is not installed here: pip install 'rangesim[campaign]'."
        ) from None
    return pyarrow
