"""The order in which loops solve one after the other."""

from graphlib import TopologicalSorter

import numpy as np
from numpy.typing import NDArray

Block = tuple[NDArray[np.intp], NDArray[np.intp]]


def block_triangular_form(incidence: NDArray[np.bool_]) -> list[Block] | None:
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
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching

    unknown_of = maximum_bipartite_matching(csr_array(incidence), perm_type="column")
    if (unknown_of < 0).any():
        return None
    dependencies = incidence[:, unknown_of]  # equation i needs the unknown of equation j
    count, label = connected_components(csr_array(dependencies.astype(float)), connection="strong")
    order = TopologicalSorter({block: set[int]() for block in range(count)})
    for i, j in np.argwhere(dependencies):
        if label[i] != label[j]:
            order.add(int(label[i]), int(label[j]))
    blocks = []
    for block in order.static_order():
        rows = np.flatnonzero(label == block)
        columns = np.sort(unknown_of[rows]).astype(np.intp)
        order_of_rows, order_of_columns = _fill_reducing_order(incidence[np.ix_(rows, columns)])
        blocks.append((rows[order_of_rows], columns[order_of_columns]))
    return blocks


def _fill_reducing_order(incidence: NDArray[np.bool_]) -> tuple[list[int], list[int]]:
    """An order of rows and columns in which reflections fill in little.

    The next column is the one whose reflection takes the fewest operations: as many rows as have
    an entry there, times the unknowns that any of them contains. These rows are alike afterwards.
    """
    pattern = incidence.copy()
    remaining_rows, remaining_columns = list(range(len(pattern))), list(range(len(pattern)))
    rows, columns = [], []
    while remaining_columns:

        def cost(column: int) -> int:
            mixed = pattern[:, column]
            return int(mixed.sum() * (pattern[mixed].any(axis=0).sum() - 1))

        column = min(remaining_columns, key=cost)
        affected = [row for row in remaining_rows if pattern[row, column]]
        pivot = min(affected, key=lambda row: int(pattern[row].sum()))
        pattern[affected] = pattern[affected].any(axis=0)
        pattern[pivot] = False
        pattern[:, column] = False
        remaining_rows.remove(pivot)
        remaining_columns.remove(column)
        rows.append(pivot)
        columns.append(column)
    return rows, columns
