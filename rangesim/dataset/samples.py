# SPDX-License-Identifier: Apache-2.0
"""The scenes of a data set as a sequence of samples, for training.

`torch.utils.data.DataLoader` takes an object with `__len__` and `__getitem__` as it is. It takes an iterable only if it
inherits from a class of torch, which this package does not need. A sequence also serves better here: the index knows
where each scene stands, so DataLoader's own samplers shuffle all scenes by a seed, and split them evenly between worker
processes and (`DistributedSampler`) between ranks, whatever the number of shards. Readers of streams, for stores that
are far away, find the shards in the format of WebDataset.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, overload

import msgspec

from rangesim.dataset.sample_files import MODELS_MEMBER, SCENE_MEMBER, SampleRecord, arrays_of, record_of
from rangesim.dataset.store import IndexRow, Store
from rangesim.settings.config import nearest


class Samples(Sequence[dict[str, Any]]):
    """The scenes of a data set that did not fail, in their order.

    A sample is a dictionary: "scene" holds the record of the scene as plain data
    (`rangesim.dataset.sample_files.SampleRecord`); "camera.1", "sensor.NAME" and "frames.NAME" hold the arrays of these
    members by name.

    Parameters
    ----------
    directory : folder of the data set.
    members : names of the members to read, such as ("camera.1", "sensor.amcw"); reading fewer takes less time. None:
        all.

    Raises
    ------
    FileFormatError
        The directory holds no complete data set, or (when a sample is read) its files are broken.
    ValueError
        The data set has no member of such a name.

    Examples
    --------
    >>> samples = Samples("out/bins", members=("camera.1", "sensor.amcw"))  # doctest: +SKIP
    >>> samples[0]["sensor.amcw"]["reading_m"].shape  # doctest: +SKIP
    (120, 160)
    """

    def __init__(self, directory: str | Path, members: Sequence[str] | None = None) -> None:
        self.store = Store(directory)
        self.rows: list[IndexRow] = [row for row in self.store.rows if row.error is None]
        self.wanted = None if members is None else tuple(members)
        if self.rows and self.wanted:
            there = _image_members(self.store.members(self.rows[0]))
            for name in self.wanted:
                if name not in there:
                    raise ValueError(f"expected members out of {', '.join(there)}, got {name!r}{nearest(name, there)}.")

    def __len__(self) -> int:
        return len(self.rows)

    def record(self, index: int) -> tuple[SampleRecord, dict[str, bytes]]:
        """The record of a scene, and the bytes of all its members by suffix."""
        members = self.store.members(self.rows[index])
        return record_of(members, self.store.place(self.rows[index])), members

    @overload
    def __getitem__(self, index: int) -> dict[str, Any]: ...

    @overload
    def __getitem__(self, index: slice) -> list[dict[str, Any]]: ...

    def __getitem__(self, index: int | slice) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place = self.store.place(self.rows[index])
        record, members = self.record(index)
        sample: dict[str, Any] = {"scene": msgspec.to_builtins(record)}
        for name in _image_members(members) if self.wanted is None else self.wanted:
            sample[name] = arrays_of(members, f"{name}.npz", place, record.sizes(name))
        return sample


def _image_members(members: Iterable[str]) -> list[str]:
    """Names of the members that hold images, without their suffix."""
    return [name.removesuffix(".npz") for name in members if name not in (SCENE_MEMBER, MODELS_MEMBER)]
