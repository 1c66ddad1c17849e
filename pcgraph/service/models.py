# SPDX-License-Identifier: Apache-2.0
"""Models of the requests and answers of the service, from which its OpenAPI document is made."""

from __future__ import annotations

from contextlib import suppress
from difflib import get_close_matches
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from pcgraph.cloud import Cloud
from pcgraph.errors import CloudWriteError
from pcgraph.families import members
from pcgraph.io import FORMATS, encode_cloud

MAX_WAIT_SECONDS = 60.0
"""Largest time in seconds for which a request waits for a segmentation, because proxies end requests after about that
time (nginx after 60 s)."""
WAIT_SECONDS = 4.0
"""Default time in seconds for which an upload waits for its segmentation, because httpx gives up after 5 s."""
MAX_NAME = 255
"""Largest count of characters in a file's name, from the limit of common file systems."""


def _label_formats() -> tuple[str, ...]:
    """Formats of bare labels, and of clouds: those that hold any column and whose libraries are installed."""
    cloud = Cloud(np.zeros((1, 3)), columns={"object": np.zeros(1, np.int32)})
    found = ["npz", "json"]
    for end in (end.removeprefix(".") for one in FORMATS for end in one.suffixes):
        with suppress(CloudWriteError):
            encode_cloud(cloud, f"labels.{end}")
            found.append(end)
    return tuple(dict.fromkeys(found))


LABEL_FORMATS = _label_formats()

Wait = Annotated[
    float,
    Field(
        ge=0.0,
        le=MAX_WAIT_SECONDS,
        description="Seconds to wait for the segmentation; 0: answer at once.",
        examples=[10.0],
    ),
]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


def _one_of(family: str, default: str, text: str) -> Any:
    """Type of a parameter that names a member of a family."""
    known = sorted(members(family))

    def check(name: str) -> str:
        if name not in known:
            raise ValueError(f"expected one of {', '.join(known)}, got {name[:80]!r}{did_you_mean(name, known)}")
        return name

    enum: dict[str, Any] = {"enum": known}
    return Annotated[str, AfterValidator(check), Field(description=text, json_schema_extra=enum, examples=[default])]


def did_you_mean(given: str, known: list[str]) -> str:
    """Hint with the nearest valid name, for the end of a message; empty if no name is near."""
    near = get_close_matches(given.lower(), known, 1)
    return f"; did you mean {near[0]}?" if near else ""


class SegmentParameters(BaseModel):
    """Parameters of `pcgraph.segment`, in the query or in the fields of a form."""

    model_config = ConfigDict(extra="forbid")

    wait: Wait = WAIT_SECONDS
    voxel_size: Positive | None = Field(
        None, description="Edge of a voxel, metres. Default: 3.5 times the spacing of the points.", examples=[0.05]
    )
    seed_size: Positive | None = Field(
        None, description="Spacing of supervoxels, metres, at least voxel_size. Default: 3 to 5 times voxel_size."
    )
    n_supervoxels: int | None = Field(
        None, ge=1, le=10_000_000, description="About how many supervoxels there are, in place of seed_size."
    )
    camera: bool | None = Field(None, description="Whether a camera took the points. Default: found from the points.")
    range_growth: float | None = Field(
        None,
        ge=0.0,
        lt=1.0,
        description="Power of the range with which voxels grow. Default: 0.5 for what looks like one scan, else 0.",
    )
    method: _one_of("SupervoxelMethod", "surface-growth", "How supervoxels form.") = "surface-growth"  # type: ignore[valid-type]
    linkage: _one_of("Linkage", "region", "How the graph becomes a tree.") = "region"  # type: ignore[valid-type]
    object_altitude: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] | None = Field(
        None, description="Altitude of the cut that gives the objects, the linkage's unit. Default: the linkage's."
    )
    viewpoint: list[Annotated[float, Field(allow_inf_nan=False)]] | None = Field(
        None,
        min_length=3,
        max_length=3,
        description="Position of the sensor, three numbers in metres: viewpoint=0&viewpoint=0&viewpoint=1.5.",
    )
    features: list[str] | None = Field(
        None,
        max_length=20,
        description="Further columns of the file that shape the supervoxels: features=intensity&features=ring.",
    )
    columns: list[str] | None = Field(
        None, max_length=100, description="Names of the columns of a text file without a header, one each."
    )
    color: bool = Field(True, description="Whether colours shape the supervoxels.")


class UploadQuery(SegmentParameters):
    """Parameters of `pcgraph.segment`, and the name of the file if that is the body itself."""

    name: str | None = Field(
        None,
        min_length=1,
        max_length=MAX_NAME,
        description="Name of the file, if the body is the file itself: its suffix tells the format.",
        examples=["scan.laz"],
    )


class CutQuery(BaseModel):
    """A cut of the tree into `n` segments, or at an altitude; without both, the objects."""

    model_config = ConfigDict(extra="forbid")

    n: int | None = Field(None, ge=1, le=1 << 31, description="Exact number of segments.", examples=[10])
    altitude: float | None = Field(
        None, ge=0.0, description="All merges up to this cost are done, the linkage's unit.", allow_inf_nan=False
    )
    min_size: int = Field(1, ge=1, le=1 << 31, description="Points that every segment has at least.")


class LabelQuery(CutQuery):
    """A cut of the tree, and the format of its labels."""

    format: str = Field(
        "npz",
        json_schema_extra={"enum": list(LABEL_FORMATS)},
        description="npz and json: the labels alone, in the shape of the input. Others: the cloud with all its columns "
        "and object, part, supervoxel, and segment if a cut is asked for.",
        examples=["npz"],
    )
    colorize: bool = Field(False, description="Whether red, green and blue are those of the objects.")


class ProblemModel(BaseModel):
    """An error, in the form of RFC 9457."""

    title: str = Field(examples=["Unprocessable Content"])
    status: int = Field(examples=[422])
    detail: str = Field(description="What was expected, what came, what to do.")


class Health(BaseModel):
    """State of the service."""

    ready: bool = Field(description="Whether a worker process is ready for clouds.")
    version: str = Field(description="Version of pcgraph.")
    workers: int = Field(description="Worker processes that are ready.")
    queued: int = Field(description="Segmentations that wait for a worker.")
    segmentations: int = Field(description="Segmentations that the service holds.")


class Summary(BaseModel):
    """Summary of a finished segmentation."""

    points: int = Field(description="Points of the cloud, also those that are not finite.")
    segmented: int = Field(description="Points that have a supervoxel.")
    outliers: int = Field(description="Points that are noise.")
    acquisition: str = Field(description="Kind of the sensor that was found, in words.")
    voxel_size: float = Field(description="Edge of a voxel, metres.")
    seed_size: float = Field(description="Spacing of supervoxels, metres.")
    supervoxels: int
    edges: int = Field(description="Edges of the graph of touching supervoxels.")
    objects: int
    object_altitude: float = Field(description="Altitude of the cut that gives the objects, the linkage's unit.")
    seconds: float = Field(description="Time that the worker took.")
    warnings: list[str] = Field(description="What seems to be wrong with the cloud, one sentence each.")


class SegmentationModel(BaseModel):
    """A segmentation: its state, and its summary or its problem."""

    id: str
    state: Literal["queued", "running", "done", "failed"]
    stage: str | None = Field(description="What the worker does now: reading, segmenting, saving.")
    ahead: int | None = Field(description="Number of segmentations before it, while it is queued.")
    seconds: float = Field(description="Time that a worker has spent on it.")
    summary: Summary | None = Field(description="Summary of the segmentation, if it is done.")
    problem: ProblemModel | None = Field(description="Reason of the failure, if it failed.")
    links: dict[str, str] = Field(description="Paths of its labels, objects, tree, view and file.")


class Points(BaseModel):
    """A small cloud in JSON."""

    model_config = ConfigDict(extra="forbid")

    points: list[Annotated[list[float], Field(min_length=3, max_length=3)]] = Field(
        min_length=1, description="x, y, z of each point, metres."
    )
    colors: list[Annotated[list[Annotated[int, Field(ge=0, le=255)]], Field(min_length=3, max_length=3)]] | None = (
        Field(None, description="Red, green, blue of each point.")
    )
    normals: list[Annotated[list[float], Field(min_length=3, max_length=3)]] | None = Field(
        None, description="Outward normal of each point."
    )


class LabelsModel(BaseModel):
    """Labels of a cut as JSON."""

    labels: list[int] | list[list[int]] = Field(
        description="Segment of each point, in the shape of the input; -1 where a point has none."
    )
    segments: int = Field(description="Number of segments.")


class BoxModel(BaseModel):
    """The oriented box around a segment."""

    segment: int
    center: list[float] = Field(description="Metres, the points' frame.")
    axes: list[list[float]] = Field(description="Unit vectors, one row each, the longest side first.")
    size: list[float] = Field(description="Full lengths along the axes, metres.")


class BoxesModel(BaseModel):
    """Boxes of the segments of a cut."""

    boxes: list[BoxModel]


class ObjectsModel(BaseModel):
    """Objects on the largest horizontal plane."""

    support: dict[str, list[float]] | None = Field(
        description="Normal and centroid of the plane, metres; null if there is no horizontal plane."
    )
    objects: list[dict[str, Any]] = Field(
        description="Each with the labels of which it consists, its count of points, standing box, free box and shape; "
        "the largest first."
    )


class TreeModel(BaseModel):
    """A segmentation tree with one entry for each node; the supervoxels come first, and the root is the last."""

    n_leaves: int = Field(description="Number of supervoxels.")
    parents: list[int] = Field(description="Parent of each node; the root is its own.")
    altitudes: list[float | None] = Field(
        description="Altitude of each node, the linkage's unit; null where parts that do not touch were joined."
    )
    sizes: list[int] = Field(description="Points of each node.")
