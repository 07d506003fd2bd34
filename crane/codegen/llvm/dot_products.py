"""Dot products of one vector with several in LLVM's language: one instruction for all of a row.

What a processor waits for in a long formula is its instructions, of which it keeps some 32 kB at
hand; those of a vector are as long as those of a number.
"""

from collections.abc import Iterable, Sequence

from crane.codegen.llvm.vector_functions import format_real

# Products may be fused with sums. Reordering sums would gain nothing and let NaN cancel.
FAST_MATH_FLAGS = "nsz arcp contract"
Operands = Sequence[float | int]


def format_operand(operand: float | int) -> str:
    """A number, or what an operation gave."""
    return f"%v{operand}" if isinstance(operand, int) else format_real(operand)


def shared_operands(operation: tuple) -> tuple:
    """What dots have in common that are taken together: the name and the first vector."""
    return operation[: 1 + len(operation) // 2]


def emit_dot_products(
    indices: Sequence[int], operands: Sequence[Operands], known_vectors: set[str]
) -> list[str]:
    """Statements that give `%d` and the first index, and each of them as a number.

    Args:
        indices: Indices of the dots.
        operands: Of each.
        known_vectors: Names of vectors that are there; takes those that are made.
    """
    kind, half, name = _vector_type(len(indices)), len(operands[0]) // 2, f"%d{indices[0]}"
    lines: list[str] = []
    total = ""
    for i in range(half):
        factor = _emit_vector([operands[0][i]] * len(indices), known_vectors, lines)
        other = _emit_vector([each[half + i] for each in operands], known_vectors, lines)
        made = name if half == 1 else f"{name}_{i}"
        lines.append(f"  {made} = fmul {FAST_MATH_FLAGS} {kind} {factor}, {other}")
        if i:
            before, made = made, name if i == half - 1 else f"{name}_{i}_"
            lines.append(f"  {made} = fadd {FAST_MATH_FLAGS} {kind} {total}, {before}")
        total = made
    lines += [
        f"  %v{index} = extractelement {kind} {name}, i32 {lane}"
        for lane, index in enumerate(indices)
    ]
    return lines


def emit_dot_product_stores(
    indices: Sequence[int], output_lanes: Iterable[tuple[int, int]]
) -> list[str]:
    """Statements that put dots into the outputs, those side by side at once.

    Args:
        indices: Indices of the dots.
        output_lanes: Places of outputs, and which of the dots goes there.
    """
    lines: list[str] = []
    runs: list[list[tuple[int, int]]] = []
    for at, lane in sorted(output_lanes):
        if runs and runs[-1][-1] == (at - 1, lane - 1):
            runs[-1].append((at, lane))
        else:
            runs.append([(at, lane)])
    for run in runs:
        at, kind, short = run[0][0], _vector_type(len(indices)), _vector_type(len(run))
        lanes = ", ".join(f"i32 {lane}" for _, lane in run)
        lines += [
            f"  %s{at} = shufflevector {kind} %d{indices[0]}, {kind} poison, "
            f"<{len(run)} x i32> <{lanes}>",
            f"  %q{at} = getelementptr double, ptr %out, i64 {at}",
            f"  store {short} %s{at}, ptr %q{at}, align 8",
        ]
    return lines


def _emit_vector(operands: Operands, known_vectors: set[str], lines: list[str]) -> str:
    """The name of a vector of numbers, whose statements are added where it is new."""
    kind, words = _vector_type(len(operands)), [format_operand(x) for x in operands]
    same = len(set(words)) == 1
    name = "%w" + "_".join(word.removeprefix("%") for word in words)
    if name in known_vectors:
        return name
    known_vectors.add(name)
    vector = "poison"
    for lane, word in enumerate(words[:1] if same else words):
        made = name if lane == len(words) - 1 else f"{name}.{lane}"
        lines.append(f"  {made} = insertelement {kind} {vector}, double {word}, i32 {lane}")
        vector = made
    if vector != name:
        lines.append(
            f"  {name} = shufflevector {kind} {vector}, {kind} poison, "
            f"<{len(words)} x i32> zeroinitializer"
        )
    return name


def _vector_type(count: int) -> str:
    return f"<{count} x double>"
