# SPDX-License-Identifier: Apache-2.0
"""A learned boundary: the probability that an edge of the graph crosses from one object to another."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcgraph.errors import CloudReadError, CloudWriteError
from pcgraph.graph.adjacency import AdjacencyGraph
from pcgraph.graph.contacts import angle_between
from pcgraph.plain_files import read_file, write_file

_FORMAT = "pcgraph edge model 1"


def edge_evidence(graph: AdjacencyGraph) -> dict[str, NDArray[np.float64]]:
    """What a model sees of each edge: columns (m,) float64 by name, free of the scene's scale.

    Angles are in radians, steps in voxel edges, and nothing depends on which end of an edge comes first.
    """
    features, nodes = graph.edge_features, graph.node_features
    i, j = graph.edges.T
    apart = nodes.centroid[i] - nodes.centroid[j]
    crease = angle_between(np.cross(nodes.normal[i], nodes.normal[j]), apart)
    apart /= np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    rise_i = np.einsum("ij,ij->i", apart, nodes.normal[i])
    rise_j = -np.einsum("ij,ij->i", apart, nodes.normal[j])
    return {
        "concavity": np.maximum(-features.convexity, 0.0),
        "convexity": np.maximum(features.convexity, 0.0),
        "contact_concavity": np.maximum(-features.contact_convexity, 0.0),
        "contact_convexity": np.maximum(features.contact_convexity, 0.0),
        "normal_angle": features.normal_angle,
        "crease_angle": np.minimum(crease, np.pi - crease),  # between the planes' crease and the way across
        "color_contrast": features.color_contrast,
        "step_voxels": features.step / features.voxel_edge,
        "lower_rise": np.minimum(rise_i, rise_j),  # sines of the angles at which each sees the other
        "upper_rise": np.maximum(rise_i, rise_j),
    }


@dataclass(frozen=True)
class EdgeModel:
    """Logistic regression on standardised evidence; plain numbers, so that a file of it cannot run code.

    Attributes
    ----------
    names : tuple of str
        Columns of `edge_evidence` that are used.
    means, scales, coefficients : tuple of float
        One per name; evidence enters as coefficient x (value - mean) / scale.
    intercept : float
    object_altitude : float, 0..1
        Probability of a boundary above which two parts are two objects.
    """

    names: tuple[str, ...]
    means: tuple[float, ...]
    scales: tuple[float, ...]
    coefficients: tuple[float, ...]
    intercept: float
    object_altitude: float

    def __post_init__(self) -> None:
        columns = (self.means, self.scales, self.coefficients)
        numbers = [*self.means, *self.scales, *self.coefficients, self.intercept, self.object_altitude]
        if any(len(column) != len(self.names) for column in columns) or not np.isfinite(numbers).all():
            raise ValueError(f"expected one finite mean, scale and coefficient for each of {len(self.names)} names")
        if not all(scale > 0.0 for scale in self.scales):
            raise ValueError("expected scales above 0; fit the model again")

    def __call__(self, graph: AdjacencyGraph) -> NDArray[np.float64]:
        """Probability of a boundary at each edge, (m,) float64, 0..1.

        Raises
        ------
        ValueError
            The model was fitted on evidence that this version does not know.
        """
        evidence = edge_evidence(graph)
        unknown = sorted(set(self.names) - set(evidence))
        if unknown:
            raise ValueError(f"expected evidence of {sorted(evidence)}, got {unknown}; fit the model again")
        logit = np.full(len(graph.edges), self.intercept)
        for name, mean, scale, weight in zip(self.names, self.means, self.scales, self.coefficients, strict=True):
            logit += weight * (evidence[name] - mean) / scale
        return 0.5 * (1.0 + np.tanh(0.5 * logit))  # the logistic function without overflow

    def save(self, path: str | PathLike[str]) -> None:
        """Nothing; writes the model as JSON, the whole file or none.

        Raises
        ------
        CloudWriteError
            The place cannot be written.
        """
        content = {"format": _FORMAT} | {field.name: getattr(self, field.name) for field in fields(self)}
        write_file(Path(path), json.dumps(content, indent=1).encode(), CloudWriteError)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> EdgeModel:
        """Model from a file that `save` wrote.

        Raises
        ------
        CloudReadError
            The file cannot be read.
        ValueError
            The file holds no such model.
        """
        text = read_file(Path(path), CloudReadError)
        try:
            content = json.loads(text)
        except RecursionError:
            raise ValueError(f"expected JSON that EdgeModel.save wrote, got {path}, which is nested too deep") from None
        except ValueError as error:
            raise ValueError(f"expected JSON that EdgeModel.save wrote, got {path}: {error}") from None
        if not isinstance(content, dict) or content.pop("format", None) != _FORMAT:
            raise ValueError(f"expected a file of format {_FORMAT!r}, got {path}; write it with EdgeModel.save")
        if set(content) != {field.name for field in fields(cls)}:
            raise ValueError(f"expected the fields of EdgeModel, got {str(sorted(content))[:200]} in {path}")
        if not isinstance(content["names"], list) or not all(isinstance(name, str) for name in content["names"]):
            raise ValueError(f"expected a list of names in {path}; write it with EdgeModel.save")
        try:
            means, scales, weights = (_numbers(content[key]) for key in ("means", "scales", "coefficients"))
            intercept, altitude = _numbers([content["intercept"], content["object_altitude"]])
            return cls(tuple(content["names"]), means, scales, weights, intercept, altitude)
        except (ValueError, OverflowError) as error:
            raise ValueError(f"{path}: {error}") from None


def _numbers(values: object) -> tuple[float, ...]:
    if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
        raise ValueError(f"expected numbers in a model, got {ascii(values)[:100]}; write it with EdgeModel.save")
    try:
        return tuple(float(value) for value in values)
    except OverflowError:
        raise ValueError("expected numbers in a model, got one beyond a float; write it with EdgeModel.save") from None
