# SPDX-License-Identifier: Apache-2.0
"""Laws of hierarchies as arrays: what each function says, on trees of five nodes and against slow references."""

from __future__ import annotations

from time import process_time

import numpy as np
import pytest
from checks import SEEDS
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from pcgraph.hierarchy import (
    accumulate_sequential,
    ancestor_index,
    binary_children,
    checked_parents,
    child_lists,
    lowest_common_ancestor,
    lowest_common_ancestors,
    num_leaves,
    propagate_sequential,
)

CHAIN = np.array([3, 3, 4, 4, 4], np.int32)  # leaves 0, 1 | 2 -> 3 = {0, 1} -> root 4
FLAT = np.array([4, 4, 4, 4, 4], np.int32)  # four leaves below one root
ONE = np.array([0], np.int32)


def random_parents(seed: int, arity: int = 2) -> NDArray[np.int32]:
    """A hierarchy of a few leaves, whose nodes have 2..arity children."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 12))
    roots, parents = list(range(n)), list(range(n))
    while len(roots) > 1:
        taken = rng.permutation(len(roots))[: rng.integers(2, arity + 1)]
        for i in taken:
            parents[roots[i]] = len(parents)
        roots = [root for i, root in enumerate(roots) if i not in taken] + [len(parents)]
        parents.append(len(parents))
    return np.array(parents, np.int32)


def path(parents: NDArray[np.int32], node: int) -> list[int]:
    """The node and all above it."""
    nodes = [node]
    while parents[nodes[-1]] != nodes[-1]:
        nodes.append(int(parents[nodes[-1]]))
    return nodes


def test_leaves_and_children():
    assert [num_leaves(parents) for parents in (CHAIN, FLAT, ONE)] == [3, 4, 1]
    assert binary_children(CHAIN).tolist() == [[-1, -1], [-1, -1], [-1, -1], [0, 1], [2, 3]]
    assert binary_children(ONE).tolist() == [[-1, -1]]
    for parents, expected in ((CHAIN, [[], [], [], [0, 1], [2, 3]]), (FLAT, [[], [], [], [], [0, 1, 2, 3]])):
        lists = child_lists(parents)
        assert [lists.nodes[a:b].tolist() for a, b in zip(lists.starts, lists.starts[1:], strict=False)] == expected


def test_sums_and_extremes_of_everything_below():
    values = np.array([[1, 10], [2, 20], [4, 40]])
    assert accumulate_sequential(CHAIN, values).tolist() == [[1, 10], [2, 20], [4, 40], [3, 30], [7, 70]]
    assert accumulate_sequential(CHAIN, values[:, 0], "max").tolist() == [1, 2, 4, 2, 4]
    assert accumulate_sequential(CHAIN, -0.5 * values[:, 0], "min").tolist() == [-0.5, -1.0, -2.0, -1.0, -2.0]
    assert accumulate_sequential(FLAT, np.array([True, True, False, True])).tolist() == [1, 1, 0, 1, 3]
    own = np.array([1, 2, 4, 8, 16])  # inner nodes bring values of their own
    assert accumulate_sequential(CHAIN, own).tolist() == [1, 2, 4, 11, 31]
    assert own.tolist() == [1, 2, 4, 8, 16]
    large = np.array([2**53 + 1, 0, 0])
    assert accumulate_sequential(CHAIN, large)[-1] == 2**53 + 1  # whole numbers stay exact


def test_values_from_the_root_down():
    values = np.array([0, 1, 2, 3, 4])
    assert propagate_sequential(CHAIN, values, np.array([True, False, False, True, True])).tolist() == [4, 1, 2, 4, 4]
    assert propagate_sequential(CHAIN, values, np.array([True, True, True, False, True])).tolist() == [3, 3, 4, 3, 4]
    rows = np.array(["a", "b", "c", "d", "e"])[:, None]
    assert propagate_sequential(CHAIN, rows, np.ones(5, bool)).tolist() == [["e"]] * 5


@given(SEEDS, st.integers(2, 5), st.sampled_from([(), (2,), (2, 3)]))
@settings(max_examples=50, deadline=None)
def test_sweeps_follow_the_paths_to_the_root(seed: int, arity: int, trailing: tuple[int, ...]):
    parents, rng = random_parents(seed, arity), np.random.default_rng(seed)
    k, n = len(parents), num_leaves(parents)
    leaf_values = rng.integers(-9, 9, (n, *trailing)).astype(np.float64)
    below = [[leaf for leaf in range(n) if node in path(parents, leaf)] for node in range(k)]
    for operation, reduce in (("sum", np.sum), ("max", np.max), ("min", np.min)):
        expected = np.stack([reduce(leaf_values[leaves], axis=0) for leaves in below])
        assert np.array_equal(accumulate_sequential(parents, leaf_values, operation), expected)
    condition, values = rng.random(k) < 0.5, rng.random((k, *trailing))
    ends = [next(i for i in path(parents, node) if not condition[i] or i == k - 1) for node in range(k)]
    assert np.array_equal(propagate_sequential(parents, values, condition), values[ends])


@given(SEEDS, st.integers(2, 5))
@settings(max_examples=50, deadline=None)
def test_where_nodes_meet(seed: int, arity: int):
    parents = random_parents(seed, arity)
    k = len(parents)
    first, second = np.divmod(np.arange(k**2), k)
    paths = [set(path(parents, node)) for node in range(k)]
    expected = np.array([min(paths[i] & paths[j]) for i, j in zip(first, second, strict=True)])
    assert np.array_equal(lowest_common_ancestors(parents, first, second), expected)
    index = ancestor_index(parents)
    assert [lowest_common_ancestor(index, i, j) for i, j in zip(first, second, strict=True)] == expected.tolist()


def test_depth_does_not_matter():
    n = 200_000  # all merges in one chain: leaf i + 1 joins what is there as node n + i
    chain = np.concatenate([[n], np.arange(n, 2 * n - 1), np.arange(n + 1, 2 * n - 1), [2 * n - 2]]).astype(np.int32)
    first, second = np.random.default_rng(0).integers(0, n, (2, n))
    lowest_common_ancestors(CHAIN, np.array([0]), np.array([1]))  # compiles
    start = process_time()
    meeting = lowest_common_ancestors(chain, first, second)
    assert process_time() - start < 2.0  # climbing node by node takes minutes
    apart = first != second
    assert np.array_equal(meeting[apart], n - 1 + np.maximum(first, second)[apart])


@pytest.mark.parametrize("parents", [CHAIN, CHAIN.tolist(), FLAT.astype(np.uint64), ONE, CHAIN.astype(np.int64)])
def test_parents_in_any_form(parents: ArrayLike):
    checked = checked_parents(parents)
    assert checked.dtype == np.int32
    assert checked.tolist() == np.asarray(parents).tolist()


@pytest.mark.parametrize(
    ("parents", "message"),
    [
        ([3.0, 3.0, 4.0, 4.0, 4.0], "whole numbers"),
        ("a", "whole numbers"),
        (0, r"parents \(k,\)"),
        (np.empty(0, int), r"parents \(k,\)"),
        ([3, 3, 4, 4, 3], "its own parent"),
        ([1, 0, 2], "larger than its node"),
        ([2, 2**40, 2], "larger than its node"),
        ([2, 4, 4, 4, 4], "leaves before all other"),
    ],
)
def test_parents_are_a_hierarchy(parents: ArrayLike, message: str):
    with pytest.raises(ValueError, match=message):
        checked_parents(parents)
