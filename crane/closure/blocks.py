"""The order in which loops solve one after the other."""

from graphlib import TopologicalSorter

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching

Block = tuple[NDArray[np.intp], NDArray[np.intp]]


def block_triangular(incidence: NDArray[np.bool_]) -> list[Block] | None:
    """Order square equations into blocks that can be solved one after the other.

    A maximum matching gives every equation an unknown of its own; the strongly connected
    components of the graph "equation i needs the unknown of equation j" are the blocks
    (Duff, Erisman, Reid: Direct Methods for Sparse Matrices, chapter 6).

    Args:
        incidence: (m, m), whether equation i contains unknown j.

    Returns:
        Blocks (rows, columns) in the order of solution, or None where the equations are
        structurally singular.
    """
    size = len(incidence)
    if size == 0:
        return []
    unknown_of = maximum_bipartite_matching(csr_array(incidence), perm_type="column")
    if (unknown_of < 0).any():
        return None
    needs = incidence[:, unknown_of]  # equation i needs the unknown of equation j
    count, label = connected_components(csr_array(needs.astype(float)), connection="strong")
    order = TopologicalSorter({block: set[int]() for block in range(count)})
    for i, j in np.argwhere(needs):
        if label[i] != label[j]:
            order.add(int(label[i]), int(label[j]))
    blocks = []
    for block in order.static_order():
        rows = np.flatnonzero(label == block)
        blocks.append((rows, np.sort(unknown_of[rows]).astype(np.intp)))
    return blocks
